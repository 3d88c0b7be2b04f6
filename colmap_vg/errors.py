"""Every error that a user or the data can cause. Each message says what was found, where, and what to do."""


class ColmapVgError(Exception):
    """Base of every error that a user can cause; the command line prints it as one line and exits with 1."""


class OptionError(ColmapVgError, ValueError):
    """An option is out of its range, or options contradict each other."""


class GraphError(ColmapVgError, ValueError):
    """A viewing graph is malformed: wrong shapes, rows out of range, matrices that are no rotations."""


class DatabaseError(ColmapVgError):
    """A COLMAP database is missing, unreadable, damaged, or holds nothing to map."""


class ImageFolderError(ColmapVgError):
    """A folder of photographs is missing, empty, or holds none that can be read."""


class DataFileError(ColmapVgError):
    """A data file has a bad row; the message names file and line."""


class OutputError(ColmapVgError):
    """The output cannot be written, or already holds a model."""


class MappingError(ColmapVgError):
    """No model could be made from the data."""

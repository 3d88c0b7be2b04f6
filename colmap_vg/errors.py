"""Errors that users or their data can cause. Each message says what was found, where, and what to do."""


class ColmapVgError(Exception):
    """Base class of all errors that users can cause; the command line prints it on one line and exits with 1."""


class CancelledError(Exception):
    """A job was cancelled: raised by a caller's ``on_event``, which stops the job, and passed on to the caller.

    No `ColmapVgError`: nothing is wrong with the data, and who handles those errors need not handle this one.
    """


class OptionError(ColmapVgError, ValueError):
    """An option is out of its range, or options contradict each other."""


class GraphError(ColmapVgError, ValueError):
    """A viewing graph is malformed: wrong shapes, rows out of range, or matrices that are not rotations."""


class DatabaseError(ColmapVgError):
    """A COLMAP database is missing, unreadable, damaged, or contains nothing to map."""


class ImageFolderError(ColmapVgError):
    """A folder of photographs is missing, empty, or contains none that can be read."""


class DataFileError(ColmapVgError):
    """A data file is missing or has a bad row; the message names file and line."""


class OutputError(ColmapVgError):
    """The output cannot be written, or already holds a model."""


class MappingError(ColmapVgError):
    """No model could be made from the data."""


class ViewerError(ColmapVgError):
    """The explorer cannot be started."""

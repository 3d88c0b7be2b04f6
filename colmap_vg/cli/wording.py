"""Errors of the library in the words of the command line: options become flags."""

import re
from dataclasses import fields

from colmap_vg.options import FeatureOptions, MappingOptions, ReadOptions, SolveOptions

_PATHS = ("image_path", "output_path", "database_path")
_OPTIONS = frozenset(_PATHS).union(
    *(
        (field.name for field in fields(options))
        for options in (FeatureOptions, ReadOptions, SolveOptions, MappingOptions)
    )
)
_VERBS = {"view_graph_mapping": "`colmap-vg mapper`"}
_ON, _VALUE = re.compile(r"\b([a-z_]+)=True\b"), re.compile(r"\b([a-z_]+)='([^' ]*)'")
_WORD = re.compile(r"(?<![\w/.'-])[a-z0-9]+(?:_[a-z0-9]+)+(?![\w/.'=])")
"""Names with an underscore that are no part of a path, of a quoted value or of an attribute."""


def with_flags(message: str) -> str:
    """A message whose options are flags.

    >>> with_flags("/a/output_path holds a model: choose another output_path, or replace it with overwrite=True")
    '/a/output_path holds a model: choose another --output_path, or replace it with --overwrite'
    """
    message = _VALUE.sub(r"--\1 \2", _ON.sub(r"--\1", message))
    return _WORD.sub(lambda found: _word(found[0]), message)


def one_line(error: BaseException) -> str:
    """The message of an error on one line, with options as flags."""
    return with_flags(" ".join(str(error).split()))


def _word(name: str) -> str:
    return f"--{name}" if name in _OPTIONS else _VERBS.get(name, name)

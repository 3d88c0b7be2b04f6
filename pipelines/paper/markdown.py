"""Markdown and CSV of tables."""

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with one line for each row, the first column to the left and the others to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def csv_text(rows: Sequence["DataclassInstance"], kind: type[Any]) -> str:
    """Dataclasses of one kind as CSV, with a line of their fields' names; floats as they print, exactly."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, [field.name for field in fields(kind)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return stream.getvalue()

"""Render the report of a finished job as one HTML file, which needs no other file and no network."""

from functools import cache
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from colmap_vg.jobs.atomic_write import atomic_write
from colmap_vg.jobs.summary import damaged_summary
from colmap_vg.report.contents import Contents, gather
from colmap_vg.report.overview import Overview, overview
from colmap_vg.report.payload import payload, script_json

FILE_NAME = "report.html"
SCRIPTS = ("data.js", "scene.js", "charts.js", "tables.js", "selection.js", "page.js")


def write_report(output_path: Path, image_path: Path | None = None, database_path: Path | None = None) -> Path:
    """Write ``report.html`` of a finished job from the files in its output folder, atomically.

    Parameters
    ----------
    output_path : Path
    image_path, database_path : Path, optional
        Folder of the photographs, and database; by default those that the job had. Neither is changed.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    ColmapVgError
        A file of the job is missing or damaged, or the report cannot be written.
    """
    contents = gather(output_path, image_path, database_path)
    try:
        told = overview(contents)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise damaged_summary(output_path) from error
    path = output_path / FILE_NAME
    atomic_write(path, render(contents, told))
    return path


def render(contents: Contents, told: Overview) -> str:
    """Return the page as HTML."""
    environment = Environment(
        loader=PackageLoader("colmap_vg.report"), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    # Constants of this package and JSON without any of HTML's characters: nothing in them is to be escaped.
    return environment.get_template("report.html.j2").render(
        overview=told,
        notes=contents.notes,
        has_matches=bool(contents.matches),
        style=Markup(_asset("report.css")),
        plotly=Markup(_plotly()),
        scripts=[Markup(_asset(name)) for name in SCRIPTS],
        data=Markup(script_json(payload(contents))),
    )


@cache
def _asset(name: str) -> str:
    return files("colmap_vg.report").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def _plotly() -> str:
    return files("plotly").joinpath("package_data", "plotly.min.js").read_text(encoding="utf-8")

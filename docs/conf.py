"""Sphinx configuration: ``sphinx-build -W --keep-going -b html docs OUT``. The build needs no network."""

import zlib  # noqa: F401  -- must come before pycolmap

# isort: split
import inspect
import re
from typing import Any, Literal, get_args, get_origin, get_type_hints

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

import colmap_vg
from colmap_vg import options
from colmap_vg.scene.verdicts import Verdict

project = "colmap_vg"
release = version = colmap_vg.__version__
author = "the colmap_vg authors"
copyright = author

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc"]
exclude_patterns = ["_build"]
templates_path = ["_templates"]
html_theme = "furo"
html_title = f"colmap_vg {release}"
html_copy_source = False

myst_enable_extensions = ["amsmath", "dollarmath"]
html_math_renderer = "mathml"
myst_heading_anchors = 3

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # numpydoc tells types with shapes and units
autodoc_default_options = {"members": True}
numpydoc_show_class_members = False
numpydoc_attributes_as_param_list = True


def field_comments(option_class: type) -> list[str]:
    """Lines of a numpydoc section for the fields of an options class, whose meanings are comments in the source."""
    hints = get_type_hints(option_class)
    pattern = re.compile(r"^    (\w+): (.+?) = (.+?)(?:  # (.+))?$", re.MULTILINE)
    lines = ["", "Parameters", "----------"]
    for name, kind, value, comment in pattern.findall(inspect.getsource(option_class)):
        if get_origin(hints[name]) is Literal:
            kind = "{" + ", ".join(map(repr, get_args(hints[name]))) + "}"
        number = re.fullmatch(r"_number\(([^,]+), ([^,]+)(?:, ([^,]+))?\)", value)
        if number is not None:
            default, low, high = number.groups()
            limits = f"{low} to {high}" if high else f"at least {low}"
            told = f"{kind}, {limits}, default {default}"
        elif value.startswith("field("):
            told = kind
        else:
            told = f"{kind}, default {value}"
        meaning = comment.replace("|", r"\|").replace("*", r"\*")
        lines += [f"{name} : {told}", *([f"    {meaning[0].upper()}{meaning[1:]}."] if meaning else [])]
    return lines


def words_with_reasons(verdicts: type[Verdict]) -> list[str]:
    """Lines of a definition list of the words of an enumeration."""
    return ["", *(line for verdict in verdicts for line in (f"``{verdict}``", f"    {verdict.reason}"))]


def describe_members(_app: object, what: str, _name: str, found: object, _options: object, lines: list[str]) -> None:
    """Add fields of options classes and words of verdicts to their docstrings, before numpydoc reads these."""
    if what != "class" or not inspect.isclass(found):
        return
    if found.__module__ == options.__name__:
        lines += field_comments(found)
    elif issubclass(found, Verdict):
        lines += words_with_reasons(found)


def visit_math(translator: Any, node: nodes.math) -> None:
    """Write a formula in a line as MathML, which browsers show without a script from a network."""
    translator.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def visit_displaymath(translator: Any, node: nodes.math_block) -> None:
    """Write a displayed formula as MathML."""
    translator.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Connect the hooks."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_displaymath, None))
    app.connect("autodoc-process-docstring", describe_members, priority=400)

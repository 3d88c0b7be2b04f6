"""Small multiples, marked abscissas, and more series than colours."""

import re
import xml.etree.ElementTree as ET

import numpy as np
from paper.plots import histograms_svg, lines_svg

SVG = "{http://www.w3.org/2000/svg}"


def _texts(drawn):
    return [element.text for element in ET.fromstring(drawn).iter(f"{SVG}text")]


def test_small_multiples_name_every_panel_and_each_histogram_once():
    panels = {f"set {k}": {"CLS": np.full(3, 10.0**k), "1C": np.ones(3)} for k in range(6)}
    texts = _texts(histograms_svg("title", "label", np.arange(4.0), panels))
    assert all(texts.count(name) == 1 for name in ("title", "label", "CLS", "1C", *panels))
    alone = _texts(histograms_svg("title", "label", np.arange(4.0), {"one": {"CLS": np.ones(3)}}))
    assert {"one", "CLS"} <= set(alone)


def test_marks_are_named_lines_at_their_abscissas():
    series = {"a": (np.array([1.0, 10.0, 100.0]), np.array([1.0, 2.0, 3.0]))}
    plain, drawn = (lines_svg("t", "x", "y", series, marks) for marks in (None, {"here": 10.0, "there": 20.0}))
    assert {"here", "there"} <= set(_texts(drawn))
    assert "here" not in _texts(plain)
    verticals = re.findall(r"M ([\d.]+) [\d.]+ \nL \1 [\d.]+ \n", drawn)
    assert len(verticals) == len(re.findall(r"M ([\d.]+) [\d.]+ \nL \1 [\d.]+ \n", plain)) + 2
    assert [text for text in _texts(drawn) if text in ("1", "10", "100")] == ["1", "10", "100"]


def test_more_series_than_colours_have_other_lines():
    series = {str(k): (np.array([1.0, 2.0]), np.array([1.0, k + 1.0])) for k in range(9)}
    paths = ET.fromstring(lines_svg("t", "x", "y", series)).iter(f"{SVG}path")
    blue = [path.get("style") for path in paths if "stroke: #0072b2; stroke-width: 1.5" in path.get("style", "")]
    dashed = ["dasharray" in style for style in blue]
    assert dashed.count(False) == dashed.count(True) == 2  # the first and the ninth line, and each in the legend

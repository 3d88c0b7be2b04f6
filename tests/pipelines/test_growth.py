"""Exponents, tables and plots of growth, and the timed problems themselves."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from benchmark.growth import Timing, fitted_exponent, growth_table, looped_scene, timed_rotation_averaging
from paper.plots import bars_svg, histogram_svg, lines_svg, points_svg


def test_exponents_are_those_that_the_times_were_made_with():
    timings = [Timing("a", n, 0.03 * n**1.3) for n in (10, 100, 700)]
    assert fitted_exponent(timings) == pytest.approx(1.3)
    assert np.isnan(fitted_exponent(timings[:1]))
    assert "| a | 10: 0.60, 100: 11.94, 700: 149.88 | 1.30 |" in growth_table({"a": timings}, "images")


def test_plots_hold_every_series_and_are_the_same_each_time():
    sizes = np.array([10.0, 100.0, 1000.0])
    series = {"one": (sizes, sizes / 7), "two": (sizes, sizes**2 / 1e4)}
    drawn = lines_svg("t < u", "images", "seconds", series)
    root = ET.fromstring(drawn)
    texts = {element.text for element in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"t < u", "images", "seconds", "one", "two"} <= texts
    markers = [e for e in root.iter("{http://www.w3.org/2000/svg}use") if "fill: #" in e.get("style", "")]
    assert len(markers) == 2 * (len(sizes) + 1)  # and one each in the legend
    assert lines_svg("t < u", "images", "seconds", series) == drawn


@pytest.mark.parametrize(
    ("drawn", "texts"),
    [
        (
            histogram_svg("h", "degrees", np.arange(4.0), {"before": np.array([0, 10, 1]), "after": np.ones(3)}),
            {"edges"},
        ),
        (bars_svg("b", "share", {"1C": 0.25, "2O": 0.5}), {"25 %", "50 %", "2O"}),
        (points_svg("p", np.array([[0, 1]]), np.eye(2), {"CLS": np.zeros((2, 2))}), {"truth", "CLS"}),
    ],
)
def test_figures_say_what_they_show(drawn, texts):
    found = {element.text for element in ET.fromstring(drawn).iter("{http://www.w3.org/2000/svg}text")}
    assert texts <= found


def test_looped_scenes_have_their_edges_and_loops():
    graph = looped_scene(200, 2000).graph
    assert 1950 <= graph.num_edges <= 2000
    apart = np.abs(graph.edges[:, 0] - graph.edges[:, 1])
    assert 5 <= (np.minimum(apart, 200 - apart) > 10).sum() <= 50
    assert timed_rotation_averaging(graph) > 0.0

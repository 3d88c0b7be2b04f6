"""Exponents, tables and plots of growth, and the timed problems themselves."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from benchmark.growth import Timing, fitted_exponent, growth_table, looped_scene, timed_rotation_averaging
from paper.svg import growth_svg


def test_exponents_are_those_that_the_times_were_made_with():
    timings = [Timing("a", n, 0.03 * n**1.3) for n in (10, 100, 700)]
    assert fitted_exponent(timings) == pytest.approx(1.3)
    assert np.isnan(fitted_exponent(timings[:1]))
    assert "| a | 10: 0.60, 100: 11.94, 700: 149.88 | 1.30 |" in growth_table({"a": timings}, "images")


def test_plots_hold_every_series_once():
    sizes = np.array([10.0, 100.0, 1000.0])
    root = ET.fromstring(growth_svg("t < u", "images", {"one": (sizes, sizes / 7), "two": (sizes, sizes**2 / 1e4)}))
    names = [child.tag.split("}")[1] for child in root]
    assert names.count("polyline") == 2
    assert names.count("circle") == 6


def test_looped_scenes_have_their_edges_and_loops():
    graph = looped_scene(200, 2000).graph
    assert 1950 <= graph.num_edges <= 2000
    apart = np.abs(graph.edges[:, 0] - graph.edges[:, 1])
    assert 5 <= (np.minimum(apart, 200 - apart) > 10).sum() <= 50
    assert timed_rotation_averaging(graph) > 0.0

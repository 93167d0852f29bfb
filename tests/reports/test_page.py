"""Plots and timelines: curves and bars where they belong, and nothing over them."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from catstream.reports.page import DASHES, SHARES, Axis, Bar, plot, timeline


def parsed(svg):
    """Points of each curve, and all texts."""
    parts = list(ElementTree.fromstring(svg).iter())
    lines = [part.get("points", "").split() for part in parts if part.tag.endswith("polyline")]
    texts = [part.text for part in parts if part.tag.endswith("text")]
    return [[tuple(map(float, point.split(","))) for point in line] for line in lines], texts


def test_a_plot_is_one_svg_with_one_line_for_each_curve():
    places = np.linspace(0, 1, 21)
    curves = {"a & b": (places, np.linspace(1, 0, 21)), "<c>": (places, np.linspace(0.5, 0, 21))}
    (first, second), texts = parsed(plot("Success", SHARES, SHARES, curves))
    assert len(first) == len(second) == 21
    assert first[0][0] < first[-1][0]
    assert first[0][1] < first[-1][1]  # down the page
    assert {"Success", "a & b", "<c>", "0.2", "1.0"} <= set(texts)


def test_nan_leaves_a_gap_and_a_curve_without_points_is_only_named():
    curves = {"gap": (np.arange(6.0), np.array([1.0, 2, np.nan, np.nan, 4, 3])), "none": (np.empty(0), np.empty(0))}
    lines, texts = parsed(plot("Lag", Axis.upto(5), Axis.upto(4), curves))
    assert [len(line) for line in lines] == [2, 2]
    assert {"gap", "none"} <= set(texts)


@pytest.mark.parametrize("value", [0.0, 1e-4, 0.031, 0.7, 1.0, 4.9, 10.0, 12.0, 99.0, 5e6])
def test_an_axis_includes_its_value_and_has_two_to_six_ticks_up_to_its_end(value):
    axis = Axis.upto(value)
    assert value <= axis.high * (1 + 1e-6)
    assert axis.ticks[0][0] == 0
    assert axis.ticks[-1][0] == axis.high
    assert 2 <= len(axis.ticks) <= 6


def test_no_two_curves_look_alike():
    curves = {str(number): (np.arange(2.0), np.arange(2.0)) for number in range(4 * len(DASHES))}
    parts = list(ElementTree.fromstring(plot("", SHARES, SHARES, curves)).iter())
    drawn, legend = (
        [(part.get("stroke"), part.get("stroke-dasharray")) for part in parts if part.tag == tag and part.get("stroke")]
        for tag in ("polyline", "line")
    )
    assert len(set(drawn)) == len(curves)
    assert legend == drawn


def test_a_bar_is_at_its_share_of_the_time():
    drawn = timeline(20.0, {"anna": [Bar(5.0, 10.0, "anna & co"), Bar(20.0, 20.0, "end")]}, {"anna": "#ff0000"})
    assert "--colour:#ff0000" in drawn
    assert re.findall(r"left:([\d.]+)%;width:([\d.]+)%", drawn) == [("25.00", "25.00"), ("100.00", "0.00")]
    assert "anna &amp; co" in drawn

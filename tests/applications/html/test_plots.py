"""Plots: one SVG each, curves where they belong, and nothing over them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from catstream.applications.html.plots import COLOURS, DASHES, SHARES, Axis, plot


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


def test_nan_leaves_a_gap():
    ys = np.array([1.0, 2.0, np.nan, np.nan, 4.0, 3.0])
    lines, _ = parsed(plot("Lag", Axis.upto(5), Axis.upto(4), {"": (np.arange(6.0), ys)}))
    assert [len(line) for line in lines] == [2, 2]


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


#: Linear RGB as people see it who lack the cones for red, or for green (Machado, Oliveira and Fernandes 2009).
_SEEN = {
    "all cones": np.eye(3),
    "without red": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
    "without green": [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9690]],
}
_OKLAB = (
    [[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]],
    [[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]],
)


@pytest.mark.parametrize("seen", _SEEN.values(), ids=_SEEN)
def test_the_colours_of_curves_are_distinguishable_by_the_colour_blind(seen):
    """In OKLab, where a difference of 0.02 is just seen side by side."""
    values = np.array([[int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)] for colour in COLOURS])
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    first, second = map(np.array, _OKLAB)
    places = np.cbrt((linear @ np.array(seen).T).clip(0, 1) @ first.T) @ second.T
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert apart[np.triu_indices(len(COLOURS), k=1)].min() > 0.1

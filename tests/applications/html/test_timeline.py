"""Timelines: bars at their times, in lanes."""

from __future__ import annotations

import re

from catstream.applications.html.page import Bar, legend, timeline


def test_a_bar_is_at_its_share_of_the_time():
    drawn = timeline(20.0, {"anna": [Bar(5.0, 10.0, "anna & co"), Bar(20.0, 20.0, "end")]}, {"anna": "#ff0000"})
    assert re.findall(r"left:([\d.]+)%;width:([\d.]+)%", drawn) == [("25.00", "25.00"), ("100.00", "0.00")]
    assert "anna &amp; co" in drawn


def test_each_lane_has_the_colour_of_its_name():
    colours = {"anna": "#ff0000", "ben": "#00ff00"}
    drawn = timeline(0.0, {"ben": [], "anna": []}, colours)
    assert re.findall(r"--colour:(#\w+)", drawn) == [colours["ben"], colours["anna"]]
    assert all(colour in legend(colours) for colour in colours.values())

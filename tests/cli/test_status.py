"""The lines of `catstream status`."""

from __future__ import annotations

from catstream.cli.attach import _format, _summary
from catstream.messages.kinds import Health


def test_a_demo_which_is_never_lost_has_no_count_of_reopening():
    counters = {"sent": 9.0, "taken": 9.0, "stored": 9.0, "skipped": 2.0}
    lines = _format(_summary("run", {"detector": [Health("detector", 1.0, counters)]})).splitlines()
    assert "source     available, 2 frames skipped" in lines
    counters["reopened"] = counters["skipped"] = 1.0
    lines = _format(_summary("run", {"detector": [Health("detector", 1.0, counters)]})).splitlines()
    assert "source     available, 1 frame skipped, reopened 1 time" in lines


def test_there_is_no_line_of_the_trees_before_the_first_of_them():
    counters = {"sent": 0.0, "taken": 0.0, "stored": 0.0, "waiting": 1.0}
    reports = {"detector": [Health("detector", 1.0, counters)], "compressor": [Health("compressor", 1.0, {"seq": 1.0})]}
    assert "trees" not in _format(_summary("run", reports))
    trees = {"leaves": 7.0, "nodes": 5.0, "level": 1.0, "bytes": 4.6e6}
    reports["compressor"] = [Health("compressor", 1.0, trees)]
    assert "trees      7 leaves, 5 nodes, level 1, 4.6 MB" in _format(_summary("run", reports)).splitlines()

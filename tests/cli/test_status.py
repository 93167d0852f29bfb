"""The lines of `catstream status`."""

from __future__ import annotations

from catstream.cli.status import _format, _summary
from catstream.messages.kinds import Health


def test_a_demo_which_is_never_lost_has_no_count_of_reopening():
    counters = {"sent": 9.0, "taken": 9.0, "stored": 9.0, "skipped": 2.0}
    lines = _format(_summary("run", {"detector": [Health("detector", 1.0, counters)]})).splitlines()
    assert "source     available, 2 frames skipped" in lines
    counters["reopened"] = 3.0
    lines = _format(_summary("run", {"detector": [Health("detector", 1.0, counters)]})).splitlines()
    assert "source     available, 2 frames skipped, reopened 3 times" in lines

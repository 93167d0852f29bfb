"""The progress line of `catstream track`: what matters most is on it, however narrow the terminal is."""

from __future__ import annotations

from io import StringIO
from types import SimpleNamespace

import pytest
from rich.console import Console

from catstream.box import Box
from catstream.cli.common import RunProgress
from catstream.messages.kinds import Track


@pytest.mark.parametrize("live", [False, True], ids=["file", "live"])
@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_the_line_fits_and_begins_with_the_state_and_the_frames(width, live):
    health = {"detector": {"skipped": 1234.0}, "compressor": {"leaves": 456.0}}
    seen = {"health": health, "lost_seconds": 0, "holding": "", "totals": {}}
    pipeline = SimpleNamespace(live=live, frames=None if live else 30000, **seen)
    written = StringIO()
    console = Console(file=written, width=width, force_terminal=True, color_system=None, soft_wrap=True)
    run = RunProgress(pipeline)
    with run.progress(console) as progress:
        run.show(progress, {"": Track(1, 0, 0.0, "bootstrapping", None, -12.25, 12345)})
        progress.refresh()
    lines = [part for part in written.getvalue().replace("\x1b[2K", "\r").split("\r") if "bootstrapping" in part]
    shown = lines[-1].split("\n")[0].split("\x1b")[0].rstrip()
    assert len(shown) <= width
    assert shown.startswith("bootstrapping")
    assert ("1/30000" in shown) != live
    assert ("12345" in shown) == (width >= 80)


def test_of_several_objects_the_line_has_the_scores_and_the_summary_a_line_for_each():
    pipeline = SimpleNamespace(live=False, frames=9, health={}, lost_seconds=0, holding="", totals={}, restarts=0)
    written = StringIO()
    console = Console(file=written, width=120, force_terminal=True, color_system=None, soft_wrap=True)
    run = RunProgress(pipeline, ["carl"])
    with run.progress(console) as progress:
        for box in (Box(1, 2, 30, 40), None):
            seen = {"anna": Track(1, 0, 0.0, "present", box, 0.9, 7, object="anna")}
            run.show(progress, seen | {"ben": Track(1, 0, 0.0, "absent", None, 0.1, 4, object="ben")})
        progress.refresh()
    assert "1/2 present" in written.getvalue()
    assert "anna +0.90  ben +0.10" in written.getvalue()
    assert run.summary([]).splitlines()[1:] == [
        "  1 carl: present in 0 of 0 frames, model version 0",
        "  2 anna: present in 1 of 2 frames, model version 7",
        "  3 ben: present in 0 of 2 frames, model version 4",
    ]

"""The progress line of `catstream track`: what matters most is on it, however narrow the terminal is."""

from __future__ import annotations

from io import StringIO
from types import SimpleNamespace

import pytest
from rich.console import Console

from catstream.cli.progress import RunProgress
from catstream.messages import Track


@pytest.mark.parametrize("live", [False, True], ids=["file", "live"])
@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_the_line_fits_and_begins_with_the_state_and_the_frames(width, live):
    health = {"detector": {"skipped": 1234.0}, "compressor": {"leaves": 456.0}}
    pipeline = SimpleNamespace(live=live, frames=None if live else 30000, health=health, lost_seconds=0, holding="")
    written = StringIO()
    console = Console(file=written, width=width, force_terminal=True, color_system=None, soft_wrap=True)
    run = RunProgress(pipeline)
    with run.progress(console) as progress:
        run.show(progress, Track(1, 0, 0.0, "bootstrapping", None, -12.25, 12345))
        progress.refresh()
    lines = [part for part in written.getvalue().replace("\x1b[2K", "\r").split("\r") if "bootstrapping" in part]
    shown = lines[-1].split("\n")[0].split("\x1b")[0].rstrip()
    assert len(shown) <= width
    assert shown.startswith("bootstrapping")
    assert ("1/30000" in shown) != live
    assert ("12345" in shown) == (width >= 80)

"""The progress line and the summary of a run, and signals."""

import io
import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest
from rich.console import Console

from catstream.base.box import Box
from catstream.cli import common
from catstream.cli.common import Interrupts, line_of
from catstream.cli.progress import RunProgress
from catstream.processes.job import Results
from catstream.wire.messages import Track

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def progress_of(seen, **pipeline):
    """The progress of a run after the tracks of some frames."""
    run = {"lost_seconds": 0, "holding": "", "totals": {}, "restarts": 0, "results": Results(write=())}
    progress = RunProgress(SimpleNamespace(**run, **pipeline))
    for tracks in seen:
        progress.count(tracks)
    return progress


def test_progress_without_a_terminal_is_a_line_at_times(monkeypatch):
    screen = Console(file=io.StringIO())
    with line_of(screen) as progress:
        task = progress.add_task("reading", total=3)
        progress.update(task, advance=1)
        monkeypatch.setattr(common, "LINE_SECONDS", -1.0)
        progress.update(task, advance=1)
    assert screen.file.getvalue().split()[:2] == ["reading", "2/3"]


@pytest.mark.parametrize("live", [False, True], ids=["file", "live"])
def test_progress_line_has_the_state_and_the_frames(live):
    health = {"detector": {"skipped": 1234.0}, "compressor": {"leaves": 456.0}}
    track = Track(0, 0.0, "bootstrapping", None, -12.25, 12345)
    line = progress_of([{"": track}], live=live, frames=None if live else 30000, health=health).line()
    assert line.startswith("bootstrapping 1  " if live else "bootstrapping 1/30000  ")
    assert line.endswith(f"{'  1234 skipped' * live}  score -12.25  model 12345  456 leaves")


def test_progress_line_has_the_reason_without_tracks():
    progress = progress_of([], live=True, frames=None, health={})
    assert progress.line() == "starting"
    progress._pipeline.holding = "paused"
    assert progress.line() == "paused"
    progress._pipeline.lost_seconds = 12.0
    assert progress.line() == "lost 12 s"


def test_progress_of_several_objects_lists_each():
    anna = [Track(0, 0.0, "present", box, 0.9, 7, object="anna") for box in (Box(1, 2, 30, 40), None)]
    ben = Track(0, 0.0, "absent", None, 0.1, 4, object="ben")
    progress = progress_of([{"anna": each, "ben": ben} for each in anna[::-1]], live=False, frames=9, health={})
    assert progress.line().startswith("1/2 present   2/9")
    assert "anna +0.90  ben +0.10" in progress.line()
    assert progress.summary().splitlines()[1:] == [
        "  anna: present in 1 of 2 frames, model version 7",
        "  ben: present in 0 of 2 frames, model version 4",
    ]


@pytest.fixture
def interrupts():
    before = {number: signal.getsignal(number) for number in SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    one = Interrupts()
    one.install()
    yield one
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", SIGNALS)
def test_signal_takes_effect_after_the_current_frame(interrupts, number):
    results, video = [], []

    def follow():
        for frame in range(10):
            with interrupts.deferred():
                results.append(frame)
                if frame == 3:
                    signal.raise_signal(number)
                video.append(frame)

    with pytest.raises(KeyboardInterrupt):
        follow()
    assert results == video == [0, 1, 2, 3]


def test_signal_during_imports_ends_the_process_at_once(interrupts, monkeypatch, capfd):
    monkeypatch.setattr(os, "_exit", sys.exit)
    with pytest.raises(SystemExit, match="130"), interrupts.leaving():
        signal.raise_signal(signal.SIGINT)
    assert capfd.readouterr().err == "stopped\n"
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_ignored_signals_stay_ignored(interrupts):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    interrupts.install()
    with interrupts.leaving():
        signal.raise_signal(signal.SIGHUP)


def test_second_signal_does_not_disturb_the_end_of_a_command():
    send = "import atexit, os, signal; atexit.register(os.kill, os.getpid(), signal.SIGINT)"
    command = [sys.executable, "-P", "-c", f"{send}; from catstream.cli import main; main()", "--version"]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ended.stderr == ""

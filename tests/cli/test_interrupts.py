"""Ctrl-C and its like, between frames and within one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from catstream.cli.common import INTERRUPTED, Interrupts

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


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
def test_a_signal_takes_effect_after_the_current_frame(interrupts, number):
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


def test_between_frames_a_signal_takes_effect_at_once(interrupts):
    with interrupts.deferred():
        pass
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_during_imports_a_signal_ends_the_process_at_once(interrupts, monkeypatch, capfd):
    monkeypatch.setattr(os, "_exit", sys.exit)
    with pytest.raises(SystemExit, match=str(INTERRUPTED)), interrupts.leaving():
        signal.raise_signal(signal.SIGINT)
    assert capfd.readouterr().err == "stopped\n"
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_ignored_signals_stay_ignored(interrupts):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    interrupts.install()
    with interrupts.leaving():
        signal.raise_signal(signal.SIGHUP)


def test_a_second_signal_does_not_disturb_the_end_of_a_command():
    send = "import atexit, os, signal; atexit.register(os.kill, os.getpid(), signal.SIGINT)"
    command = [sys.executable, "-P", "-c", f"{send}; from catstream.cli import main; main()", "--version"]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ended.stderr == ""

"""The log of a process, as its supervisor reads it."""

from __future__ import annotations

import signal
from contextlib import closing

import pytest

from catstream.services.process import STOPPED_EARLY
from catstream.services.supervisor import Child, ProcessLog


def test_new_lines_are_those_of_the_process_itself_and_a_line_without_an_end_waits(tmp_path):
    with (tmp_path / "log").open("w+b") as file, closing(ProcessLog("detector", file)) as log:
        file.write(b"detector: an earlier one\n")
        file.flush()
        log.begin()
        assert log.last_line() == ""
        file.write(b"detector: one\nTraceback\ndetector: tw")
        file.flush()
        assert log.new_lines() == ["an earlier one", "one"]
        file.write(b"o\n")
        file.flush()
        assert log.new_lines() == ["two"]
        assert log.last_line() == "two"


def test_a_line_that_is_longer_than_what_is_read_at_once_does_not_hide_the_next_one(tmp_path):
    with (tmp_path / "log").open("w+b") as file, closing(ProcessLog("detector", file)) as log:
        file.write(b"detector: " + bytes(200_000) + b"\ndetector: the source is lost\n")
        file.flush()
        assert [line for _ in range(9) for line in log.new_lines()] == ["the source is lost"]


@pytest.mark.parametrize(
    ("code", "ending"),
    [
        (-signal.SIGKILL, "with signal SIGKILL"),
        (-signal.SIGABRT, "with signal SIGABRT: its last line"),
        (-(signal.SIGRTMIN + 1), f"with signal {signal.SIGRTMIN + 1}"),
        (1, "with exit code 1: its last line"),
        (STOPPED_EARLY, "as a signal asked it to end"),
    ],
)
def test_the_reason_of_a_death_is_the_signal_and_what_the_process_itself_has_said_of_it(tmp_path, code, ending):
    child = Child("trainer", tmp_path, tmp_path)
    with closing(child.log), (tmp_path / "trainer.log").open("ab") as file:
        file.write(b"trainer: its last line\n")
        file.flush()
        assert child.ending(code) == ending
        child.log.begin()
        assert child.ending(code) == ending.removesuffix(": its last line")

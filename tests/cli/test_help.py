"""Help teaches: what a verb does, what it writes, and an example that works."""

from __future__ import annotations

import subprocess
import sys

import pytest

from catstream.cli import VERBS
from catstream.services.supervisor import NAMES


def help_of(*arguments):
    run = subprocess.run([sys.executable, *arguments, "--help"], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0
    assert not run.stderr
    return " ".join(run.stdout.split())


MAIN = ["-c", "from catstream.cli import main; main()"]


def test_the_command_names_its_verbs_and_shows_how_to_start():
    text = help_of(*MAIN)
    assert all(verb in text for verb in VERBS)
    assert "catstream track walk.mp4 --box 120,80,64,48" in text


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_says_what_it_does(verb):
    assert help_of(*MAIN, verb).startswith(f"Usage: catstream {verb}")


def test_track_says_what_it_writes_and_how_it_is_stopped():
    text = help_of(*MAIN, "track")
    for word in ("NAME.txt", "NAME_confidence.value", "NAME_time.txt", "tracks.csv", "NAME.mp4", "Ctrl-C", "EXAMPLES"):
        assert word in text


def test_a_verb_that_does_not_exist_is_refused():
    run = subprocess.run([sys.executable, *MAIN, "trakc"], capture_output=True, text=True, timeout=60)
    assert run.returncode == 2
    assert "No such command 'trakc'" in run.stderr


@pytest.mark.parametrize("name", [*NAMES, "supervisor"])
def test_every_process_says_what_it_does(name):
    assert help_of("-m", "catstream.services", name).startswith(f"Usage: python -m catstream.services {name}")

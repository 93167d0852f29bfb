"""The state of a process in the kernel."""

from __future__ import annotations

import os
import signal
import subprocess

from catstream.services.process_title import is_ending, is_suspended


def test_a_suspended_process_is_ending_from_the_moment_at_which_it_is_killed():
    """It ends once the kernel runs it again, so each of many has a chance to be seen before that."""
    for _ in range(30):
        with subprocess.Popen(["sleep", "600"]) as process:
            os.kill(process.pid, signal.SIGSTOP)
            os.waitpid(process.pid, os.WUNTRACED)
            assert is_suspended(process.pid)
            assert not is_ending(process.pid)
            os.kill(process.pid, signal.SIGKILL)
            assert is_ending(process.pid)

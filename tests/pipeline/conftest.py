"""What the tests of the pipeline share: a short video, and how to wait for processes."""

from __future__ import annotations

import random
import socket
import subprocess
import sys
import time
from contextlib import ExitStack

import psutil
import pytest

from catstream.video.demo import write
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import private_folder

FRAMES, SIZE = 160, (320, 240)
PORTS = max(channel.port + len(channel.senders) for channel in CHANNELS.values())


@pytest.fixture(scope="session")
def video(tmp_path_factory):
    """A short demo video, and the object's box in each of its frames."""
    path, boxes = write(tmp_path_factory.mktemp("video"), FRAMES, SIZE)
    return str(path), boxes


@pytest.fixture
def folder():
    """A private folder with a name that is short enough for sockets."""
    with private_folder() as path:
        yield path


@pytest.fixture
def tcp():
    """An endpoint on as many free ports in a row as the channels take."""
    for first in random.sample(range(20000, 32000, PORTS), 50):
        with ExitStack() as stack:
            try:
                for port in range(first, first + PORTS):
                    stack.enter_context(socket.socket()).bind(("127.0.0.1", port))
            except OSError:
                continue
        return f"tcp://127.0.0.1:{first}"
    raise AssertionError("no free ports on this machine")


@pytest.fixture
def until():
    """Wait until a condition holds, and return what it returned; fail where it does not within a minute."""

    def wait(condition, seconds=60.0):
        deadline = time.monotonic() + seconds
        while not (found := condition()):
            assert time.monotonic() < deadline, "it did not happen in time"
            time.sleep(0.01)
        return found

    return wait


@pytest.fixture
def alive():
    """Whether a process runs; one that ended and was not asked for its exit code yet does not."""

    def runs(pid):
        try:
            return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
        except psutil.NoSuchProcess:
            return False

    return runs


@pytest.fixture
def service():
    """Starts `python -m catstream.services ...`; what still runs after the test is killed."""
    with ExitStack() as stack:

        def start(*arguments):
            process = subprocess.Popen(
                [sys.executable, "-m", "catstream.services", *map(str, arguments)],
                stderr=subprocess.PIPE,
                text=True,
            )
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start

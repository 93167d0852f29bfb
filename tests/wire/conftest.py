"""What the tests of the wire share."""

from __future__ import annotations

import random
import socket
import time

import pytest

from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint, private_folder

PORTS = max(channel.port + len(channel.senders) for channel in CHANNELS.values())


def free_ports() -> int:
    """The first of as many free ports in a row as the channels take."""
    for first in random.sample(range(20000, 32000, PORTS), 50):
        try:
            for port in range(first, first + PORTS):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return first
    raise AssertionError("no free ports on this machine")


@pytest.fixture
def folder():
    """A private folder with a name that is short enough for sockets."""
    with private_folder() as path:
        yield path


@pytest.fixture
def tcp():
    """A tcp endpoint that is free."""
    return f"tcp://127.0.0.1:{free_ports()}"


@pytest.fixture(params=["ipc", "tcp"])
def endpoint(request, folder):
    """Where to meet, over each transport."""
    return Endpoint.parse(str(folder) if request.param == "ipc" else request.getfixturevalue("tcp"))


@pytest.fixture
def until():
    """Call a function until a condition holds; fail where it does not within seconds."""

    def wait(condition, turn, seconds=20.0):
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, "it did not happen in time"
            turn()

    return wait

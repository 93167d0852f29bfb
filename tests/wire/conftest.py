"""Fixtures of the tests of sockets."""

from contextlib import ExitStack

import pytest
import zmq

from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint


@pytest.fixture(params=["ipc", "tcp"])
def endpoint(request, folder):
    """An endpoint of each transport."""
    return Endpoint.parse(str(folder) if request.param == "ipc" else request.getfixturevalue("tcp"))


@pytest.fixture
def stranger(endpoint):
    """A raw socket of a given kind at a channel's address."""
    with ExitStack() as stack:

        def connect(kind, name):
            socket = stack.enter_context(zmq.Context.instance().socket(kind))
            socket.linger = 0
            socket.connect(endpoint.address(CHANNELS[name]))
            return socket

        yield connect

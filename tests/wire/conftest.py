"""What the tests of the wire share."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
import pytest
import zmq

from catstream.messages.kinds import End, Health, Model, Preview, Run, Sample, SavedModel, Track
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint


@pytest.fixture(params=["ipc", "tcp"])
def endpoint(request, folder):
    """Where to meet, over each transport."""
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


@pytest.fixture
def message_of():
    """A message of a published channel, by its name."""
    messages = {
        Track: Track(1, 0, 0.0, "absent", None, 0.0, 0),
        Sample: End(1, "nothing was learned"),
        Model: Model(1, 1, np.ones(3, np.float32), 0.0),
        Health: Health("detector", 0.0),
        Preview: Preview(1, 64, 48, {}, b"\xff\xd8\xff"),
        SavedModel: SavedModel(1, b"the bytes of a file"),
        Run: End(1, "nothing was learned"),
    }
    return lambda name: messages[CHANNELS[name].messages[0]]

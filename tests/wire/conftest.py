"""What the tests of the wire share."""

from __future__ import annotations

import pytest

from catstream.wire.endpoint import Endpoint


@pytest.fixture(params=["ipc", "tcp"])
def endpoint(request, folder):
    """Where to meet, over each transport."""
    return Endpoint.parse(str(folder) if request.param == "ipc" else request.getfixturevalue("tcp"))

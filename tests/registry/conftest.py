"""What the tests of the registry share: a controller of a fleet in a thread, with a state that the test decides."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Event

import pytest

from catstream.client.registry import RegistryServer
from catstream.messages.kinds import FleetStatus
from catstream.wire.endpoint import Endpoint
from catstream.wire.keys import allow, create


@contextmanager
def _managing(status: FleetStatus, text: str = "", keys: str = "") -> Iterator[Endpoint]:
    """A controller that answers with this state of the fleet, which may change meanwhile."""
    over = Event()

    def serve() -> None:
        while not over.is_set():
            server.turn(0.01)

    with RegistryServer(text, keys, lambda: status) as server, ThreadPoolExecutor(1) as pool:
        serving = pool.submit(serve)
        try:
            yield server.endpoint
        finally:
            over.set()
            serving.result(20)


@pytest.fixture
def managing():
    """Starts a controller of a fleet."""
    return _managing


@pytest.fixture
def fleet_keys(folder):
    """The keys of a fleet, and beside them those of a client that may watch."""
    create(folder / "keys")
    allow(folder / "keys", "anna", "watch", output=folder / "anna")
    return folder / "keys"

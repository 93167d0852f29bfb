"""What the tests of the registry share: the state of a fleet that a test decides, and keys."""

import pytest

from catstream.wire.keys import allow, create


@pytest.fixture
def managing(managing):
    """Serves the registry of a fleet of this state, which may change meanwhile: its endpoint."""
    return lambda status, *more: managing(lambda: status, *more)


@pytest.fixture
def fleet_keys(folder):
    """The keys of a fleet, and beside them those of a client that may watch."""
    create(folder / "keys")
    allow(folder / "keys", "anna", "watch", output=folder / "anna")
    return folder / "keys"

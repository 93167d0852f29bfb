"""What the tests of the registry share: the state of a fleet that a test decides, and keys."""

import pytest


@pytest.fixture
def managing(managing):
    """Serves the registry of a fleet of this state, which may change meanwhile: its endpoint."""
    return lambda status, *more: managing(lambda: status, *more)

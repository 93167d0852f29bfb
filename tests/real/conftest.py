"""Real sequences: beside the project in ../shared/data, or where TRACKING_DATA says."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from catstream.applications.evaluation.datasets import Sequence, find_sequences

DATA = Path(os.environ.get("TRACKING_DATA") or Path(__file__).parents[3] / "shared" / "data")


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of all sequences; the test is skipped where there is none."""
    if not DATA.is_dir():
        pytest.skip(f"no real sequences at {DATA}: put some there, or set TRACKING_DATA")
    return DATA


@pytest.fixture(scope="session")
def real(data: Path) -> Callable[[str], Sequence]:
    """A real sequence by its name; the test is skipped where it is absent."""

    def find(name: str) -> Sequence:
        if not (data / name).is_dir():
            pytest.skip(f"{name} is not in {data}")
        return find_sequences(data / name)[0]

    return find

"""A short sequence with truth, cut from the demo video."""

from pathlib import Path

import numpy as np
import pytest

from catstream.evaluation.datasets import Sequence, find_sequences


@pytest.fixture
def sequence(walk: Path) -> Sequence:
    return find_sequences(walk)[0]


@pytest.fixture
def found(sequence: Sequence) -> np.ndarray:
    """Boxes a little beside the truth, float64 (12, 4)."""
    return np.nan_to_num(sequence.boxes, nan=30.0) + np.array([2, 1, 1, -1])

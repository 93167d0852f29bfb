"""Real sequences are followed, and absence is noticed."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.applications.evaluation.onepass import evaluate
from catstream.settings import Settings


@pytest.mark.parametrize(
    ("name", "success"),
    [
        ("TLD_02_jumping", 0.9),
        ("TLD_04_pedestrian2", 0.95),
        ("OTB_Crossing", 0.9),
        pytest.param("TLD_01_david", 0.9, marks=pytest.mark.slow),
        pytest.param("TLD_06_car", 0.95, marks=pytest.mark.slow),
    ],
)
def test_the_object_is_followed(real, name, success):
    sequence = real(name)
    (run,) = evaluate([sequence], ["catstream"], Settings())
    assert run.score().success >= success
    absent = np.isnan(sequence.boxes).any(axis=1)
    if absent.any():
        assert np.isnan(run.boxes[absent]).any(axis=1).mean() > 0.5

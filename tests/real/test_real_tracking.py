"""Real sequences are followed, and absence is noticed."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.applications.evaluation.onepass import evaluate
from catstream.settings import Settings


@pytest.mark.parametrize(
    ("name", "success", "noticed"),
    [
        ("TLD_01_david", 0.9, 0.0),
        ("TLD_02_jumping", 0.9, 0.0),
        ("TLD_04_pedestrian2", 0.95, 0.5),
        ("TLD_06_car", 0.95, 0.2),  # it is hidden three times for a short time, and mostly tracked on
        ("OTB_Crossing", 0.9, 0.0),
    ],
)
def test_the_object_is_followed(real, name, success, noticed):
    sequence = real(name)
    (run,) = evaluate([sequence], ["catstream"], Settings())
    score = run.score()
    assert score.success >= success
    if noticed:
        absent = np.isnan(sequence.boxes).any(axis=1)
        assert np.isnan(run.boxes[absent]).any(axis=1).mean() >= noticed
        assert score.long_term.f_score >= 0.75

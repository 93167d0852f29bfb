"""The Kalman filter of the centre: smooth while present, at rest while lost, anew after a jump."""

import numpy as np
import pytest

from catstream.detection.belief import at_rest, measured, predicted
from catstream.messages.kinds import Motion


@pytest.fixture
def motion() -> Motion:
    """Random changes of a tenth of a pixel a frame, centres measured within two pixels."""
    return Motion(process=0.01 * np.eye(4), observation=4.0 * np.eye(2))


def moving(motion: Motion, frames: int = 60) -> np.ndarray:
    """The estimate of an object that went 3 pixels right and 1 up a frame, to (100 + 3 frames, 200 - frames)."""
    estimate = at_rest((100, 200), motion)
    for frame in range(1, frames + 1):
        estimate = measured(predicted(estimate, motion), motion, (100 + 3 * frame, 200 - frame))
    return estimate


def test_a_lost_object_coasts_to_a_stop(motion):
    estimate = moving(motion)
    (x, y, *velocity), *_ = estimate
    for _ in range(500):
        estimate = predicted(estimate, motion, lost=True)
    assert np.hypot(*estimate[0, 2:]) < 1e-6
    assert np.hypot(*(estimate[0, :2] - (x, y))) < 5.01 * np.hypot(*velocity)


def test_an_object_that_reappears_has_a_higher_belief_than_one_that_never_left(motion):
    never_left, back = moving(motion), moving(motion)
    for _ in range(30):
        back = predicted(back, motion, lost=True)
    shares = []
    for estimate in (never_left, back):
        expected = predicted(estimate, motion)
        x, y = expected[0, :2]
        shares.append((measured(expected, motion, (x + 5, y))[0, 0] - x) / 5)
    assert shares[0] < 0.3 < 0.6 < shares[1]


def test_a_jump_is_a_new_start_at_rest(motion):
    estimate = measured(predicted(moving(motion), motion), motion, (40, 40))
    np.testing.assert_array_equal(estimate, at_rest((40, 40), motion))

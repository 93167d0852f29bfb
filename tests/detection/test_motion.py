"""The Kalman filter of the centre: smooth while present, at rest while absent, anew after a jump."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.detection.motion import CentreFilter
from catstream.messages import Motion


@pytest.fixture
def motion() -> Motion:
    """Pushes of a tenth of a pixel a frame, centres measured within two pixels."""
    return Motion(process=0.01 * np.eye(4), observation=4.0 * np.eye(2))


def moving(motion: Motion, frames: int = 60) -> CentreFilter:
    """A filter that has seen an object go 3 pixels right and 1 up a frame, to (100 + 3 frames, 200 - frames)."""
    centre = CentreFilter(motion, (100, 200))
    for frame in range(1, frames + 1):
        centre.predict()
        centre.update((100 + 3 * frame, 200 - frame))
    return centre


def distance(a: tuple[float, float], b: tuple[float, float]) -> float:
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def test_predicts_the_next_centre_of_steady_motion(motion):
    centre = moving(motion)
    assert centre.velocity == pytest.approx((3, -1), abs=1e-3)
    assert centre.predict() == pytest.approx((283, 139), abs=0.01)


def test_estimates_are_nearer_than_measurements(motion, rng):
    centre = CentreFilter(motion, (0, 0))
    errors = []
    for frame in range(1, 400):
        true = (frame, 2 * frame)
        measured = tuple(true + rng.normal(scale=2, size=2))
        centre.predict()
        centre.update(measured)
        errors.append((distance(centre.centre, true), distance(measured, true)))
    estimated, measured = np.mean(errors, axis=0)
    assert estimated < 0.6 * measured


def test_an_absent_object_coasts_to_a_stop(motion):
    centre = moving(motion)
    start, speed = centre.centre, np.hypot(*centre.velocity)
    for _ in range(500):
        centre.predict()
        centre.update(None)
    assert np.hypot(*centre.velocity) < 1e-6
    assert distance(centre.centre, start) < 5.01 * speed


def test_an_absent_object_is_less_certain_every_frame(motion):
    centre = moving(motion)
    deviations = []
    for _ in range(50):
        centre.predict()
        centre.update(None)
        deviations.append(centre.deviation)
    assert np.all(np.diff(deviations) > 0)


def test_an_object_that_comes_back_is_believed_more_than_one_that_never_left(motion):
    never_left, back = moving(motion), moving(motion)
    for _ in range(30):
        back.predict()
        back.update(None)
    shares = []
    for centre in (never_left, back):
        x, y = centre.predict()
        centre.update((x + 5, y))
        shares.append((centre.centre[0] - x) / 5)
    assert shares[0] < 0.3 < 0.6 < shares[1]


def test_a_jump_is_a_new_start_at_rest(motion):
    centre = moving(motion)
    centre.predict()
    centre.update((40, 40))
    assert centre.centre == (40, 40)
    assert centre.velocity == (0, 0)


def test_adopted_covariances_change_the_trust_and_not_the_state(motion):
    centre, doubting = moving(motion), moving(motion)
    doubting.adopt(Motion(motion.process, 100 * motion.observation))
    assert doubting.centre == centre.centre
    for each in (centre, doubting):
        each.predict()
        each.update((286, 139))
    assert distance(doubting.centre, (283, 139)) < 0.2 * distance(centre.centre, (283, 139))


def test_it_is_the_kalman_filter_of_the_textbook(motion, rng):
    centre = moving(motion, 5)
    F, H, Q, R = np.eye(4) + np.eye(4, k=2), np.eye(2, 4), motion.process, motion.observation
    x, P = centre.state[0], centre.state[1:]
    for _ in range(50):
        z = np.add(centre.predict(), rng.normal(size=2))
        centre.update(tuple(z))
        x, P = F @ x, F @ P @ F.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ (z - H @ x), (np.eye(4) - K @ H) @ P
        np.testing.assert_allclose(centre.state, np.vstack([x, P]), rtol=1e-9, atol=1e-9)

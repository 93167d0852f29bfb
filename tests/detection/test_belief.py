"""Belief: its levels, their actions, and the Kalman filter of the centre."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.box import Window
from catstream.base.settings import Settings
from catstream.detection import belief
from catstream.detection.belief import at_rest, predict, update
from catstream.wire.messages import DetectorState, Motion

SETTINGS = Settings()
BELIEF, TABLE = SETTINGS.belief, belief.policies(SETTINGS.search.full_interval)
WINDOW = Window(60.0, 50.0, 48.0, 40.0)
ACTIONS = ("report", "resize", "teach")
SCORES = st.floats(-1, 2, width=32)
LEVELS = st.sampled_from(["lost", "redetected", "weak", "confident"])

#: All states of a detector that has found its object.
STATES = st.builds(DetectorState, st.just(0), LEVELS, *[st.just(WINDOW)] * 3, st.booleans())


def done(level):
    """The actions that are taken at a level."""
    return {action for action in ACTIONS if getattr(TABLE[level], action)}


def searches(level):
    """Searches of the whole frame in each frame."""
    interval = TABLE[level].search_interval
    return 1 / interval if interval else 0


@given(SCORES, SCORES, st.booleans())
def test_higher_score_allows_more_and_searches_less(one, other, trusted):
    low, high = (belief.level_of(score, trusted, BELIEF) for score in sorted((one, other)))
    assert done(low) <= done(high)
    assert searches(low) >= searches(high)


@given(SCORES)
def test_trust_allows_training_and_searches_less(score):
    doubted, trusted = (belief.level_of(score, each, BELIEF) for each in (False, True))
    assert "teach" not in done(doubted)
    assert searches(doubted) >= searches(trusted)


@given(STATES, SCORES, st.booleans())
def test_lost_object_needs_a_higher_score_to_return(state, score, redetected):
    lost, present = (
        belief.update_level(dataclasses.replace(state, level=level), score, redetected, BELIEF).level
        for level in ("lost", "weak")
    )
    assert present != "lost" or lost == "lost"


@given(STATES, SCORES, st.booleans())
def test_redetected_object_is_distrusted_until_a_high_score(state, score, redetected):
    after = belief.update_level(state, score, redetected, BELIEF)
    assert after.trusted == (score >= BELIEF.trusted_score or (state.trusted and not redetected))
    assert (after.level == "redetected") == (not after.trusted and after.level != "lost")


def test_object_without_a_detection_is_lost_at_any_score():
    state = DetectorState(0, "lost", WINDOW, WINDOW, None)
    assert belief.update_level(state, 2.0, False, BELIEF).level == "lost"


@pytest.fixture
def motion() -> Motion:
    """Random changes of a tenth of a pixel a frame, centres measured within two pixels."""
    return Motion(process=0.01 * np.eye(4), observation=4.0 * np.eye(2))


def moving(motion: Motion, frames: int = 60) -> np.ndarray:
    """The estimate of an object that went 3 pixels right and 1 up a frame, to (100 + 3 frames, 200 - frames)."""
    estimate = at_rest((100, 200), motion)
    for frame in range(1, frames + 1):
        estimate = update(predict(estimate, motion), motion, (100 + 3 * frame, 200 - frame))
    return estimate


def test_lost_object_coasts_to_a_stop(motion):
    estimate = moving(motion)
    (x, y, *velocity), *_ = estimate
    for _ in range(500):
        estimate = predict(estimate, motion, lost=True)
    assert np.hypot(*estimate[0, 2:]) < 1e-6
    assert np.hypot(*(estimate[0, :2] - (x, y))) < 5.01 * np.hypot(*velocity)


def test_reappearing_object_follows_its_measurement_more(motion):
    never_left, back = moving(motion), moving(motion)
    for _ in range(30):
        back = predict(back, motion, lost=True)
    shares = []
    for estimate in (never_left, back):
        expected = predict(estimate, motion)
        x, y = expected[0, :2]
        shares.append((update(expected, motion, (x + 5, y))[0, 0] - x) / 5)
    assert shares[0] < 0.3 < 0.6 < shares[1]


def test_jump_is_a_new_start_at_rest(motion):
    estimate = update(predict(moving(motion), motion), motion, (40, 40))
    np.testing.assert_array_equal(estimate, at_rest((40, 40), motion))

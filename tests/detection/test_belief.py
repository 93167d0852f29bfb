"""Belief: the levels, and the table of what the detector does at each."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.box import Window
from catstream.detection import belief
from catstream.detection.belief import ALWAYS
from catstream.messages import DetectorState
from catstream.settings import Settings

SETTINGS = Settings()
BELIEF, TABLE = SETTINGS.belief, belief.policies(SETTINGS)
WINDOW = Window(60.0, 50.0, 48.0, 40.0)
ACTIONS = ("resize", "recentre", "remember", "teach", "mine")
SCORES = st.floats(-1, 2, width=32)
LEVELS = st.sampled_from(["lost", "redetected", "weak", "confident"])


@st.composite
def states(draw):
    """Any state of a detector that has found its object."""
    level, trusted = draw(LEVELS), draw(st.booleans())
    return DetectorState(0, level, WINDOW, WINDOW, WINDOW, trusted, draw(st.floats(0, 1)))


def done(level, score):
    """The actions that are taken at a level and a score."""
    return {action for action in ACTIONS if score >= getattr(TABLE[level], action)} | (
        {"report"} if TABLE[level].reported else set()
    )


def searches(level):
    """Searches of the whole frame in each frame."""
    interval = TABLE[level].search_interval
    return 1 / interval if interval else 0


@given(SCORES, SCORES, st.booleans())
def test_a_higher_score_allows_all_that_a_lower_one_does_and_searches_no_more_often(one, other, trusted):
    low, high = (
        (belief.level_of(score, BELIEF.present_score, trusted, BELIEF), score) for score in sorted((one, other))
    )
    assert done(*low) <= done(*high)
    assert searches(low[0]) >= searches(high[0])


@given(SCORES)
def test_trust_allows_all_that_distrust_does_and_searches_no_more_often(score):
    doubted, trusted = (belief.level_of(score, BELIEF.present_score, each, BELIEF) for each in (False, True))
    assert done(doubted, score) <= done(trusted, score)
    assert searches(doubted) >= searches(trusted)


@given(SCORES)
def test_a_redetected_object_is_reported_and_trains_nothing(score):
    assert "report" in done("redetected", score)
    assert not done("redetected", score) & {"teach", "mine", "recentre"}


@given(SCORES)
def test_a_lost_object_is_not_reported_and_changes_nothing(score):
    assert not done("lost", score)
    assert TABLE["lost"].search_interval == 1


@given(SCORES)
def test_hard_negatives_are_searched_for_only_if_the_frame_is_learned_from(score):
    for level in TABLE:
        assert "mine" not in done(level, score) or "teach" in done(level, score)


def test_the_table_cannot_be_changed():
    with pytest.raises(TypeError):
        TABLE["weak"] = TABLE["confident"]
    with pytest.raises(dataclasses.FrozenInstanceError):
        TABLE["weak"].teach = ALWAYS


@given(states(), SCORES, st.booleans())
def test_a_lost_object_needs_at_least_the_score_to_return_that_it_needs_to_stay(state, score, redetected):
    lost, present = (
        belief.updated(dataclasses.replace(state, level=level), score, redetected, BELIEF).level
        for level in ("lost", "weak")
    )
    assert present != "lost" or lost == "lost"


@given(states(), SCORES, st.booleans())
def test_an_object_is_distrusted_from_its_redetection_until_it_scores_high(state, score, redetected):
    after = belief.updated(state, score, redetected, BELIEF)
    assert after.trusted == (score >= BELIEF.trust_score or (state.trusted and not redetected))
    assert (after.level == "redetected") == (not after.trusted and after.level != "lost")


@given(states(), SCORES, st.booleans())
def test_the_usual_score_follows_the_score_while_the_object_is_present_and_rests_while_it_is_lost(
    state, score, redetected
):
    before, after = state.usual_score, belief.updated(state, score, redetected, BELIEF)
    if after.level == "lost":
        assert after.usual_score == before
    else:
        assert after.usual_score == pytest.approx(before + 0.01 * (score - before))


@given(states(), SCORES, st.booleans())
def test_a_belief_that_is_updated_leaves_the_state_before_as_it_was(state, score, redetected):
    before = dataclasses.replace(state)
    belief.updated(state, score, redetected, BELIEF)
    assert state == before


def test_an_object_that_was_never_found_is_lost_whatever_it_scores():
    state = DetectorState(0, "lost", WINDOW, WINDOW, None)
    assert belief.updated(state, 2.0, False, BELIEF).level == "lost"

"""Laws of pacing: how far the detector is ahead of learning, in every order of events."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from catstream.services.pacing import Awaited, awaited

FRAMES = 40
SAMPLES = 3  # each so many frames lead to a sample


@given(st.integers(0, 12), st.randoms(use_true_random=False))
def test_the_detector_is_never_further_ahead_than_the_lag_and_always_gets_to_the_end(lag, random):
    sent = taken = newest = 0

    def sample_of(seq):
        return max(min(seq, taken), 0) // SAMPLES

    while sent < FRAMES:
        due = sent - lag
        able = {
            "compressor": taken < sent,
            "trainer": newest < sample_of(taken),
            "detector": awaited(due, taken, sample_of(due), newest) is Awaited.NOTHING,
        }
        event = random.choice([name for name, may in able.items() if may])  # one of them can always go on
        if event == "compressor":
            taken += 1
        elif event == "trainer":
            newest += 1
        else:
            assert taken >= due
            assert newest >= sample_of(due)
            sent += 1


@given(st.integers(-9, 9), st.integers(0, 9), st.integers(0, 9), st.integers(0, 9))
def test_a_model_is_awaited_only_after_the_features_are_received(due, taken, sample, newest):
    found = awaited(due, taken, sample, newest)
    assert (found is Awaited.TAKEN) == (taken < due)
    assert (found is Awaited.MODEL) == (taken >= due and newest < sample)

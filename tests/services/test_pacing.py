"""Laws of pacing: how far the detector is ahead of learning, in every order of events."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from catstream.services.pacing import Awaited, awaited

FRAMES = 40
EVERY = {"anna": 3, "ben": 5}  # each so many frames lead to a sample of the object


@given(st.integers(0, 12), st.randoms(use_true_random=False))
def test_the_detector_is_never_further_ahead_than_the_lag_and_always_gets_to_the_end(lag, random):
    sent = taken = 0
    newest = dict.fromkeys(EVERY, 0)

    def samples_of(seq):
        return {name: max(min(seq, taken), 0) // every for name, every in EVERY.items()}

    while sent < FRAMES:
        due = sent - lag
        able = {
            "compressor": taken < sent,
            "detector": awaited(due, taken, samples_of(due), newest) is Awaited.NOTHING,
        } | {name: newest[name] < version for name, version in samples_of(taken).items()}
        event = random.choice([name for name, may in able.items() if may])  # one of them can always go on
        if event == "compressor":
            taken += 1
        elif event in newest:
            newest[event] += 1
        else:
            assert taken >= due
            assert all(newest[name] >= version for name, version in samples_of(due).items())
            sent += 1


versions = st.dictionaries(st.sampled_from(["", "anna", "ben"]), st.integers(0, 9))


@given(st.integers(-9, 9), st.integers(0, 9), versions, versions)
def test_a_model_is_awaited_only_after_the_features_are_received_and_for_an_object_that_is_tracked(
    due, taken, samples, newest
):
    found = awaited(due, taken, samples, newest)
    behind = any(newest[name] < samples[name] for name in samples.keys() & newest.keys())
    assert (found is Awaited.TAKEN) == (taken < due)
    assert (found is Awaited.MODEL) == (taken >= due and behind)

"""Laws of resuming: from where a detector continues, whatever the others answer."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from catstream.box import Box, Window
from catstream.messages import DetectorState, Model, Position
from catstream.services.desired import DesiredState
from catstream.services.resume import agree, start

BOX = Box(1.0, 2.0, 30.0, 40.0)
STATE = DetectorState(0, "confident", *3 * (Window(*BOX),))

seqs = st.integers(0, 50)
versions = st.integers(0, 9)
positions = st.builds(
    Position, seq=seqs, box=st.none() | st.just(BOX), version=versions, detector=st.none() | st.just(STATE)
)
models = st.none() | st.builds(Model, versions.filter(bool), seqs, st.just(np.empty(0, np.float32)), st.just(0.0))
states = st.builds(DesiredState, box=st.none() | st.just(BOX), begins=seqs)
histories = st.tuples(st.lists(positions, min_size=1, max_size=2), models, states)


def begin(history):
    received, model, desired = history
    return start(received, model, desired, lambda _box, _first: STATE)


@given(histories)
def test_no_receiver_misses_a_message(history):
    received, _, desired = history
    first = begin(history).seq + 1
    assert all(first <= position.seq + 1 for position in received)
    assert first >= 1
    assert first == min(position.seq for position in received) + 1 or first == max(desired.begins, 1)


@given(histories)
def test_a_detector_state_is_resumed_only_with_its_model_and_for_the_same_object(history):
    received, model, desired = history
    found = begin(history)
    assert (found.detector is None) == (found.model is None)
    if found.detector is not None:
        assert found.model is model
        assert received[0].version
        assert found.seq >= max(desired.begins, 1)


@given(histories)
def test_without_a_model_of_the_object_it_begins_at_its_first_frame(history):
    received, _, desired = history
    if not received[0].version:
        assert begin(history).seq < max(desired.begins, 1)
        assert begin(history).detector is None


@given(positions, models)
def test_compressor_and_trainer_agree_if_there_is_no_sample_or_its_model_is_here(features, model):
    expected = features.version == (0 if model is None or not features.version else model.version)
    assert agree(features, model) == expected


def test_a_state_that_nobody_knows_is_made_of_the_last_and_the_first_box():
    model = Model(1, 5, np.empty(0, np.float32), 0.0)
    made = []
    last, first = Box(5.0, 6.0, 30.0, 40.0), BOX

    def state_at(*boxes):
        made.append(boxes)
        return STATE

    found = start([Position(5, 4, last, 1)], model, DesiredState(first, begins=1), state_at)
    assert (found.seq, found.detector, made) == (5, STATE, [(last, first)])

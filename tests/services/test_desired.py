"""The file of the desired state: it holds all that was commanded."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from catstream.box import Box
from catstream.services.desired import DesiredObject, DesiredState

BOX = Box(1.0, 2.0, 30.0, 40.0)
names = st.sampled_from(["", "anna", "ben"])
events = st.lists(st.tuples(names, st.sampled_from([None, "", "a", "b"])), max_size=9)


@given(events, st.booleans(), st.booleans())
def test_the_state_is_read_as_it_was_written(tmp_path_factory, events, paused, stopped):
    state = after(events, DesiredState(paused=paused, stopped=stopped))
    file = tmp_path_factory.mktemp("state") / "desired_state.json"
    state.save(file)
    assert DesiredState.load(file) == state


@given(events)
def test_the_objects_of_each_message_are_known_later_in_the_order_in_which_they_began(events):
    last = after(events)
    for seq in range(len(events) + 1):
        assert [*last.objects_at(seq).items()] == [*after(events[:seq]).objects.items()]


@given(events)
def test_the_saved_models_of_the_objects_of_later_messages_are_known(events):
    last = after(events)
    for first in range(1, len(events) + 1):
        seqs = range(first, len(events) + 1)
        needed = {each.model for seq in seqs for each in last.objects_at(seq).values()} - {""}
        assert last.models_since(first) == needed


def after(events, state=DesiredState()):  # noqa: B008
    """The state after objects have begun, with a saved model or without, or were forgotten, one event a message."""
    for seq, (name, model) in enumerate(events, start=1):
        if model is not None:
            state = state.begun(name, DesiredObject(BOX, seq, model))
        elif name in state.objects:
            state = state.without(name, seq - 1)
    return state

"""The life of a stream: the table, and the laws of what happens to a stream on any cluster."""

from dataclasses import replace

import hypothesis.strategies as st
import pytest
from hypothesis import given

from catstream.fleet import lifecycle
from catstream.fleet.lifecycle import TABLE, Actor, event
from catstream.fleet.spec import StreamSpec

GATE = StreamSpec("gate", "demo:1")
ACTORS = st.builds(
    Actor,
    st.sampled_from(["pending", "working", "stopping"]),
    order=st.sampled_from([GATE.order, "another"]),
    happened=st.sampled_from(["", "reports", "interrupted", "superseded", "ended"]),
)


@given(ACTORS)
def test_a_stream_that_is_not_wanted_ends(actor):
    """By the table, it is absent after two more events at most; three if its process has just died."""
    happened = event(None, actor, 1.0)
    if actor.state == "stopping":
        assert event(None, replace(actor, happened="gone"), 1.0) == "gone"
        assert event(None, replace(actor, happened=""), 1000.0) == "silent"
    elif (actor.state, actor.happened) == ("working", "interrupted"):
        assert TABLE[actor.state, happened] == ("pending", "")
    else:
        assert happened == "unwanted"
        assert TABLE[actor.state, happened][0] == "stopping"


@pytest.mark.parametrize("state", ["pending", "working"])
def test_a_stream_of_another_digest_cores_or_labels_is_stopped(state):
    actor = Actor(state, order=GATE.order)
    assert event(GATE, actor, 0.0) is None
    for changed in (replace(GATE, source="demo:2"), replace(GATE, cores=2.0), replace(GATE, labels={"site": "x"})):
        assert event(changed, actor, 0.0) == "unwanted"


def test_one_that_hangs_is_started_again_and_one_that_does_not_stop_is_killed():
    running = Actor("working", order=GATE.order, answered=10.0)
    assert event(GATE, running, 10.0 + lifecycle.SILENT_SECONDS) is None
    assert event(GATE, running, 11.0 + lifecycle.SILENT_SECONDS) == "silent"
    stopping = replace(running, state="stopping", since=10.0)
    assert event(GATE, stopping, 11.0 + lifecycle.STOPPING_SECONDS) == "silent"
    assert event(GATE, replace(running, state="pending"), 1e6) is None, "Ray waits for a node"


def test_one_that_is_gone_at_once_is_started_again_after_a_pause():
    assert event(GATE, Actor(), 0.0) == "wanted"
    assert event(GATE, Actor(started=10.0), 10.0 + lifecycle._PAUSE_SECONDS / 2) is None
    assert event(GATE, Actor(started=10.0), 10.0 + lifecycle._PAUSE_SECONDS) == "wanted"

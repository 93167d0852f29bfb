"""The life of a stream: the table, and the laws of what happens to a stream on any cluster."""

from dataclasses import replace

import hypothesis.strategies as st
import pytest
from hypothesis import given

from catstream.fleet import lifecycle
from catstream.fleet.lifecycle import TABLE, Actor, Node, event, order
from catstream.fleet.spec import StreamSpec

GATE = StreamSpec("gate", "demo:1")
NORTH = StreamSpec("gate", "demo:1", labels={"site": "north"})

IDS = st.sampled_from(["1", "2", "3"])
LABELS = st.sampled_from([{}, {"site": "north"}])
NODE = st.builds(Node, st.just("north"), IDS, labels=LABELS, alive=st.booleans(), draining=st.booleans())
NODES = st.lists(NODE, unique_by=lambda node: node.id)
SPECS = st.sampled_from([GATE, NORTH, StreamSpec("gate", "demo:2"), replace(GATE, cores=2.0)])


@st.composite
def actors(draw):
    """An actor that was started for what was wanted then, on the cluster as it was then."""
    state = draw(st.sampled_from(["pending", "working", "stopping"]))
    happened = draw(st.sampled_from(["", "reports", "interrupted", "superseded", "ended"]))
    return Actor(state, order=order(draw(SPECS), draw(NODES)), node=draw(IDS), happened=happened)


@given(SPECS, NODES, NODES)
def test_a_stream_on_a_living_node_where_it_may_be_stays_whatever_happens_to_others(spec, nodes, before):
    for node in nodes:
        actor = Actor("working", order=order(spec, before), node=node.id, happened="reports")
        if node.alive:
            assert event(spec, actor, nodes, 1.0) == ("reports" if node.suits(spec) else "unwanted")


@given(actors(), NODES)
def test_a_stream_that_is_not_wanted_ends(actor, nodes):
    """By the table, it is absent after two more events at most; three if its process has just died."""
    happened = event(None, actor, nodes, 1.0)
    if actor.state == "stopping":
        assert event(None, replace(actor, happened="gone"), nodes, 1.0) == "gone"
        assert event(None, replace(actor, happened=""), nodes, 1000.0) == "silent"
    elif (actor.state, actor.happened) == ("working", "interrupted"):
        assert TABLE[actor.state, happened] == ("pending", "")
    else:
        assert happened == "unwanted"
        assert TABLE[actor.state, happened][0] == "stopping"


@pytest.mark.parametrize("state", ["pending", "working"])
def test_a_stream_of_another_digest_cores_drained_node_or_missing_label_is_stopped(state):
    nodes = [Node("n1", "1", labels={"site": "north"}), Node("n2", "2")]
    actor = Actor(state, order=order(NORTH, nodes), node="1")
    assert event(NORTH, actor, nodes, 0.0) is None
    for changed in (replace(NORTH, source="demo:2"), replace(NORTH, cores=2.0), replace(NORTH, labels={"site": "x"})):
        assert event(changed, actor, nodes, 0.0) == "unwanted"
    assert event(NORTH, actor, [replace(nodes[0], draining=True), nodes[1]], 0.0) == "unwanted"


def test_a_stream_of_a_dead_node_is_not_stopped_if_an_uncordoned_node_can_run_it():
    """Its order still excludes that node. Nobody would answer, and it would be killed only later."""
    nodes = [Node("n1", "1", alive=False), Node("n2", "2")]
    before = order(GATE, [Node("n1", "1"), Node("n2", "2", draining=True)])
    died = Actor("working", order=before, happened="interrupted")
    assert event(GATE, died, nodes, 0.0) == "interrupted"
    assert event(GATE, replace(died, state="pending"), nodes, 0.0) == "unwanted"


def test_one_that_hangs_is_started_again_and_one_that_does_not_stop_is_killed():
    running = Actor("working", order=order(GATE, []), answered=10.0)
    assert event(GATE, running, [], 10.0 + lifecycle.SILENT_SECONDS) is None
    assert event(GATE, running, [], 11.0 + lifecycle.SILENT_SECONDS) == "silent"
    stopping = replace(running, state="stopping", since=10.0)
    assert event(GATE, stopping, [], 11.0 + lifecycle.STOPPING_SECONDS) == "silent"
    assert event(GATE, replace(running, state="pending"), [], 1e6) is None, "Ray waits for a node"


def test_one_that_is_gone_at_once_is_started_again_after_a_pause():
    assert event(GATE, Actor(), [], 0.0) == "wanted"
    assert event(GATE, Actor(started=10.0), [], 10.0 + lifecycle._PAUSE_SECONDS / 2) is None
    assert event(GATE, Actor(started=10.0), [], 10.0 + lifecycle._PAUSE_SECONDS) == "wanted"

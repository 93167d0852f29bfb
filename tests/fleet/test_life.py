"""The life of a stream: the table, and the laws of what happens to a stream on any cluster."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import hypothesis.strategies as st
import pytest
from hypothesis import given

from catstream.fleet import life, timing
from catstream.fleet.life import TABLE, Node, Order, Seen, Step, Wanted, diff, event

IDS = st.sampled_from(["1", "2", "3"])
LABELS = st.sampled_from([{}, {"site": "north"}])
NODES = st.lists(
    st.builds(
        lambda id_, labels, alive, draining: Node(f"n{id_}", id_, labels=labels, alive=alive, draining=draining),
        IDS,
        LABELS,
        st.booleans(),
        st.booleans(),
    ),
    unique_by=lambda node: node.id,
)
WANTED = st.builds(Wanted, st.sampled_from(["a", "b"]), st.just(1.0), LABELS, st.sampled_from(["", "1", "2"]))


@st.composite
def seen(draw):
    """An actor that was started for what was wanted then, on the cluster as it was then."""
    order = draw(st.none() | st.builds(Wanted.order, WANTED, NODES))
    happened = draw(st.sampled_from(["", "reports", "interrupted", "superseded", "ended"]))
    return Seen(draw(st.sampled_from(["pending", "working", "stopping"])), 0.0, 0.0, order, draw(IDS), happened)


def test_each_state_and_event_is_described_and_each_state_is_left():
    assert set(life.STATES) == set(get_args(life.State))
    assert set(life.EVENTS) == set(get_args(life.Event))
    for state in life.STATES:
        assert any(before == state and after != state for (before, _), (after, _) in TABLE.items())
    assert {action for _, action in TABLE.values()} == set(get_args(life.Action))


@given(WANTED, NODES)
def test_a_stream_that_was_just_placed_where_it_may_be_stays(wanted, nodes):
    order = wanted.order(nodes)
    for node in nodes:
        if node.alive and wanted.fits(node) and order.node in ("", node.id):
            assert (
                event(wanted, Seen("working", order=order, node=node.id, happened="reports"), nodes, 1.0) == "reports"
            )


@given(WANTED, NODES)
def test_no_stream_is_sent_to_a_node_that_drains(wanted, nodes):
    order, leaving = wanted.order(nodes), sorted(node.id for node in nodes if node.draining)
    assert order.selector.get("ray.io/node-id", "") == (f"!in({','.join(leaving)})" if leaving else "")
    assert order.node not in leaving
    assert order.node in ("", wanted.pinned)


@given(seen(), NODES)
def test_a_stream_that_is_not_wanted_ends(actor, nodes):
    """By the table, it is absent after two more events at most; three if its process has just died."""
    happened = event(None, actor, nodes, 1.0)
    if actor.state == "stopping":
        assert event(None, replace(actor, happened="gone"), nodes, 1.0) == "gone"
        assert event(None, actor, nodes, 1000.0) in ("silent", actor.happened)
    elif (actor.state, actor.happened) == ("working", "interrupted"):
        assert TABLE[actor.state, happened] == ("pending", "")
    else:
        assert happened == "unwanted"
        assert TABLE[actor.state, happened][0] == "stopping"


@given(WANTED, seen(), NODES)
def test_a_stream_is_started_only_if_there_is_no_actor_of_it(wanted, actor, nodes):
    assert event(wanted, Seen("absent"), nodes, 0.0) == "wanted"
    assert event(wanted, actor, nodes, 0.0) != "wanted"
    assert [before for before, (_, action) in TABLE.items() if action == "start"] == [("absent", "wanted")]


@given(WANTED, seen(), NODES)
def test_a_stream_on_a_node_where_it_may_be_is_stopped_only_if_it_was_changed_or_moved(wanted, actor, nodes):
    node = next((node for node in nodes if node.id == actor.node and node.alive), None)
    is_same = actor.order is not None and actor.order.digest == wanted.digest
    is_elsewhere = wanted.target(nodes) not in (None, node)
    if node is not None and wanted.fits(node) and is_same and not is_elsewhere and actor.state != "stopping":
        assert event(wanted, actor, nodes, 0.0) != "unwanted"


@pytest.mark.parametrize("state", ["pending", "working"])
def test_a_stream_of_another_digest_cores_drained_node_or_missing_label_is_stopped(state):
    nodes = [Node("n1", "1", labels={"site": "north"}), Node("n2", "2")]
    before = Wanted("a1", labels={"site": "north"})
    running = Seen(state, order=before.order(nodes), node="1")
    assert event(before, running, nodes, 0.0) is None
    for changed in (Wanted("a2"), Wanted("a1", 2.0), Wanted("a1", pinned="2"), Wanted("a1", labels={"site": "south"})):
        assert event(changed, running, nodes, 0.0) == "unwanted"
    assert event(before, running, [replace(nodes[0], draining=True), nodes[1]], 0.0) == "unwanted"


@pytest.mark.parametrize("wanted", [Wanted("a1"), Wanted("a1", pinned="1")])
def test_a_stream_whose_node_died_is_left_to_ray_and_stays_elsewhere_if_the_node_returns(wanted):
    order = wanted.order([Node("n1", "1"), Node("n2", "2")])
    without = [Node("n1", "1", alive=False), Node("n2", "2")]
    assert event(wanted, Seen("pending", order=order), without, 0.0) is None
    assert wanted.order(without) == Order("a1", 1.0, {})
    again = [Node("n1", "3"), Node("n2", "2")]
    assert event(wanted, Seen("working", order=order, answered=0.0, node="2"), again, 0.0) is None


def test_a_stream_whose_node_died_is_not_asked_to_stop_if_it_may_run_again_on_a_node_that_was_drained():
    """Its order still excludes that node. Nobody would answer, and it would be killed only later."""
    wanted, nodes = Wanted("a1"), [Node("n1", "1", alive=False), Node("n2", "2")]
    order = wanted.order([Node("n1", "1"), Node("n2", "2", draining=True)])
    died = Seen("working", order=order, answered=0.0, happened="interrupted")
    assert diff({"gate": wanted}, {"gate": died}, nodes, 0.0) == {"gate": Step("interrupted", "pending", "")}
    pending = replace(died, state="pending")
    assert diff({"gate": wanted}, {"gate": pending}, nodes, 0.0) == {"gate": Step("unwanted", "stopping", "kill")}


def test_one_that_hangs_is_started_again_and_one_that_does_not_stop_is_killed():
    wanted = Wanted("a1")
    running = Seen("working", order=wanted.order([]), answered=10.0)
    assert event(wanted, running, [], 10.0 + timing.SILENT_SECONDS) is None
    assert event(wanted, running, [], 11.0 + timing.SILENT_SECONDS) == "silent"
    stopping = replace(running, state="stopping", since=10.0)
    assert event(wanted, stopping, [], 11.0 + timing.STOPPING_SECONDS) == "silent"
    assert event(wanted, replace(running, state="pending"), [], 1e6) is None, "Ray waits for a node"


def test_one_that_an_earlier_controller_started_may_say_for_what():
    adopted = Seen("pending", since=0.0)
    assert event(Wanted("a1"), adopted, [], 5.0) is None
    assert event(Wanted("a1"), adopted, [], 60.0) == "unwanted"


def test_one_that_is_gone_at_once_is_started_again_after_a_pause():
    wanted = Wanted("a1")
    assert event(wanted, Seen("absent", since=10.0), [], 10.0 + timing.PAUSE_SECONDS / 2) is None
    assert event(wanted, Seen("absent", since=10.0), [], 10.0 + timing.PAUSE_SECONDS) == "wanted"


@given(st.dictionaries(IDS, WANTED), st.dictionaries(IDS, seen()), NODES)
def test_the_difference_is_that_of_each_stream_by_the_table(wanted, actors, nodes):
    steps = diff(wanted, actors, nodes, 0.0)
    for name in wanted.keys() | actors.keys():
        actor = actors.get(name, Seen("absent"))
        happened = event(wanted.get(name), actor, nodes, 0.0)
        known = (actor.state, happened) in TABLE
        assert steps.get(name) == (Step(happened, *TABLE[actor.state, happened]) if known else None)

"""The manager's decisions in random histories: nodes die, return, drain and are overloaded, streams are added, changed,
moved and removed, they fail and end, and the manager forgets all. No process, no cluster, no clock."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from catstream.fleet.placement import Node, may_host
from catstream.fleet.reconcile import Actor, Desired, Memory, Start, Stop, reconcile

STREAMS = [f"cam-{number}" for number in range(6)]
NODES = ["north-1", "north-2", "south-1"]

streams, nodes = st.sampled_from(STREAMS), st.sampled_from(NODES)
cores = st.sampled_from([0.5, 1.0, 1.5, 3.0])
labels = st.sampled_from([{}, {}, {"site": "north"}, {"site": "south"}, {"site": "east"}])


class Histories(RuleBasedStateMachine):
    """A manager, its nodes, and the actors on them as the manager observes them."""

    @initialize()
    def begin(self):
        self.now, self.memory = 100.0, Memory()
        self.nodes = {name: Node(name, 2.0 + (name == "north-1"), {"site": name[:5]}) for name in NODES}
        self.desired, self.actors, self.unopenable = {}, {}, set()
        self.plan = None

    # What the shell of the manager does.

    @rule(seconds=st.sampled_from([0.5, 0.5, 2.0, 30.0, 70.0]))
    def turn(self, seconds):
        self.now += seconds
        before = dict(self.actors)
        self.plan = reconcile(self.memory, self.desired, self.nodes.values(), self.actors, self.now)
        self.memory = self.plan.memory
        for name in self.plan.unpinned:
            self.desired[name] = replace(self.desired[name], pinned=None)
        for action in self.plan.actions:
            if isinstance(action, Stop):
                self.check_stop(action)
                actor = self.actors.pop(action.name)
                if actor.phase not in ("ended", "unopened"):  # these occupy no cores, and are gone at once
                    self.actors[action.name] = replace(actor, phase="stopping", since=self.now)
            else:
                self.check_start(action, before)
                self.actors[action.name] = Actor(action.node, action.digest, "starting", self.now)
        for name, reason in self.plan.unplaced.items():
            assert reason.startswith(f"{name} needs ")
            assert any(node in reason for node in NODES)

    def check_start(self, start, before):
        assert isinstance(start, Start)
        old = before.get(start.name)
        assert old is None or not self.nodes[old.node].alive, "never two actors of a stream"
        each, node = self.desired[start.name], self.nodes[start.node]
        assert start.digest == each.digest
        assert may_host(node, each.labels)
        used = sum(self.cores_of(name) for name, actor in self.actors.items() if actor.node == node.name)
        assert used + each.cores <= node.cores, "the node's cores are never exceeded"

    def check_stop(self, stop):
        actor, each = self.actors[stop.name], self.desired.get(stop.name)
        assert actor.phase != "stopping"
        if each is None or actor.has_failed or actor.digest != each.digest:
            return
        node = self.nodes[actor.node]
        is_moved = each.pinned not in (None, node.name) and may_host(self.nodes[each.pinned], each.labels)
        assert not may_host(node, each.labels) or is_moved or node.overloaded, "what is unchanged is not touched"
        assert actor.is_working

    def cores_of(self, name):
        """Cores that the actor of a stream occupies."""
        actor = self.actors[name]
        if actor.phase in ("ended", "unopened"):
            return 0.0
        return self.desired[name].cores if name in self.desired else actor.cores

    @rule()
    def actors_go_on(self):
        """What starts runs, or cannot open its source; what stops is gone."""
        for name, actor in list(self.actors.items()):
            if not self.nodes[actor.node].alive:
                continue
            if actor.phase == "stopping":
                del self.actors[name]
            elif actor.phase == "starting":
                phase = "unopened" if (name, actor.node) in self.unopenable else "running"
                self.actors[name] = replace(actor, phase=phase, since=self.now)

    # What happens.

    @rule(name=streams, digest=st.sampled_from("ab"), cores=cores, labels=labels)
    def a_stream_is_added_or_changed(self, name, digest, cores, labels):
        self.desired[name] = Desired(digest, cores, labels)

    @rule(name=streams)
    def a_stream_is_removed(self, name):
        each = self.desired.pop(name, None)
        if each is not None and name in self.actors:
            self.actors[name] = replace(self.actors[name], cores=each.cores)

    @rule(name=streams, cores=cores)
    def a_stream_is_measured(self, name, cores):
        if name in self.desired:
            self.desired[name] = replace(self.desired[name], cores=cores)

    @rule(name=streams, node=nodes)
    def a_stream_is_moved(self, name, node):
        if name in self.desired:
            self.desired[name] = replace(self.desired[name], pinned=node)

    @rule(name=nodes, actors_are_left=st.booleans())
    def a_node_dies(self, name, actors_are_left):
        """It is killed, or frozen: then its actors are there if it comes back."""
        self.nodes[name] = replace(self.nodes[name], alive=False)
        if not actors_are_left:
            self.actors = {stream: actor for stream, actor in self.actors.items() if actor.node != name}

    @rule(name=nodes)
    def a_node_returns(self, name):
        self.nodes[name] = replace(self.nodes[name], alive=True)

    @rule(name=nodes, draining=st.booleans(), overloaded=st.booleans())
    def a_node_is_drained_or_overloaded(self, name, draining, overloaded):
        self.nodes[name] = replace(self.nodes[name], draining=draining, overloaded=overloaded)

    @rule(name=streams, phase=st.sampled_from(["failed", "ended", None]))
    def an_actor_fails_ends_or_dies(self, name, phase):
        actor = self.actors.get(name)
        if actor is None or actor.phase != "running" or not self.nodes[actor.node].alive:
            return
        if phase is None:
            del self.actors[name]
        else:
            self.actors[name] = replace(actor, phase=phase, since=self.now)

    @rule(name=streams, node=nodes)
    def a_source_is_not_visible_from_a_node(self, name, node):
        self.unopenable.add((name, node))

    @rule()
    def the_manager_starts_anew(self):
        self.memory = Memory()

    # At the end nothing more happens, and the fleet settles.

    def teardown(self):
        if not hasattr(self, "nodes"):
            return
        self.unopenable.clear()
        for name, node in self.nodes.items():
            self.nodes[name] = replace(node, overloaded=False)
        for _ in range(24):
            self.turn(20.0)
            self.actors_go_on()
        self.turn(0.5)
        assert not self.plan.actions
        assert {name for name, actor in self.actors.items() if self.nodes[actor.node].alive} <= self.desired.keys()
        for name, each in self.desired.items():
            actor = self.actors.get(name)
            is_there = actor is not None and self.nodes[actor.node].alive
            if self.plan.memory.ended.get(name) == each.digest:
                assert not (is_there and actor.is_working)
            elif name not in self.plan.unplaced:
                assert is_there
                assert actor.phase == "running"
                assert actor.digest == each.digest
                assert may_host(self.nodes[actor.node], each.labels)
            elif is_there:
                assert actor.phase == "running"
                assert not may_host(self.nodes[actor.node], each.labels)


TestHistories = Histories.TestCase
TestHistories.settings = settings(max_examples=150, stateful_step_count=50)


class Fleet:
    """Streams and nodes; each turn carries out its actions at once."""

    def __init__(self, *nodes, **desired):
        self.nodes, self.desired = {node.name: node for node in nodes}, desired
        self.memory, self.actors, self.now = Memory(), {}, 0.0
        self.unopenable = set()

    def plan(self, seconds=0.5):
        self.now += seconds
        plan = reconcile(self.memory, self.desired, self.nodes.values(), self.actors, self.now)
        self.memory = plan.memory
        return plan

    def turn(self, seconds=0.5):
        """Carry out a plan at once; return the nodes of what was started, and what was stopped."""
        actions = self.plan(seconds).actions
        for action in actions:
            if isinstance(action, Stop):
                del self.actors[action.name]
            else:
                phase = "unopened" if action.node in self.unopenable else "running"
                self.actors[action.name] = Actor(action.node, action.digest, phase, self.now)
        return [action.node if isinstance(action, Start) else action.name for action in actions]

    def change(self, name, **values):
        self.desired[name] = replace(self.desired[name], **values)

    def change_node(self, name, **values):
        self.nodes[name] = replace(self.nodes[name], **values)


def test_the_pause_after_a_failure_doubles_to_a_minute_and_is_forgotten_after_a_minute_of_running():
    fleet, pauses = Fleet(Node("n1", 2.0), a=Desired("1", 1.0)), []
    fleet.turn()
    for _ in range(8):
        fleet.actors["a"] = Actor("n1", "1", "failed", fleet.now)
        failed = fleet.now
        assert fleet.turn(0.5) == ["a"]
        pauses.append(fleet.plan(0.0).waiting["a"] - failed)
        assert fleet.turn(pauses[-1] - 1.0) == []
        assert fleet.turn(0.5) == ["n1"]
    assert pauses == [1, 2, 4, 8, 16, 32, 60, 60]
    fleet.turn(60.0)
    assert not fleet.memory.failures


def test_a_source_that_cannot_be_opened_is_tried_on_every_other_node_before_it_is_tried_there_again():
    fleet = Fleet(*(Node(name, 2.0) for name in ("n1", "n2", "n3")), a=Desired("1", 1.0))
    fleet.unopenable = {"n1", "n2", "n3"}
    started = [node for _ in range(12) for node in fleet.turn(60.0) if node != "a"]
    assert started == ["n1", "n2", "n3"] * 2


def test_a_changed_stream_is_stopped_first_and_then_started():
    fleet = Fleet(Node("n1", 2.0), a=Desired("1", 1.0), b=Desired("1", 1.0))
    fleet.turn()
    fleet.change("a", digest="2")
    assert fleet.turn() == ["a"]
    assert fleet.turn() == ["n1"]
    assert fleet.actors["a"].digest == "2"


def test_the_streams_of_a_dead_node_are_started_elsewhere_in_the_same_turn():
    fleet = Fleet(Node("n1", 2.0), Node("n2", 1.0), a=Desired("1", 1.0))
    assert fleet.turn() == ["n1"]
    fleet.change_node("n1", alive=False)
    assert [action.reason for action in fleet.plan(0.5).actions] == ["n1 died"]
    fleet.memory = Memory()
    assert fleet.turn() == ["n2"]


def test_a_pin_holds_until_its_node_drains_and_is_then_given_up():
    fleet = Fleet(Node("n1", 2.0), Node("n2", 1.0), a=Desired("1", 1.0))
    fleet.turn()
    fleet.change("a", pinned="n2")
    assert fleet.turn() == ["a"]
    assert fleet.turn() == ["n2"]
    fleet.change_node("n2", draining=True)
    assert fleet.plan(0.5).unpinned == ["a"]


def test_a_stream_that_must_leave_its_node_and_fits_nowhere_else_runs_on():
    fleet = Fleet(Node("n1", 1.0), Node("n2", 1.0), a=Desired("1", 1.0), b=Desired("1", 1.0))
    fleet.turn()
    fleet.change_node("n1", draining=True)
    plan = fleet.plan()
    assert not plan.actions
    assert plan.unplaced == {
        "a": "a needs 1 core, and there are fewer free: n2 has 0 of 1: give it fewer cores, or add a node"
    }
    assert plan.more_nodes == 1


def test_an_overloaded_node_gives_its_smallest_stream_away_and_no_other_one_for_a_while():
    small, large = Desired("1", 0.5), Desired("1", 1.0)
    fleet = Fleet(Node("n1", 3.0), a=small, b=large, c=large)
    fleet.turn()
    fleet.nodes["n2"] = Node("n2", 3.0)
    fleet.change_node("n1", overloaded=True)
    assert fleet.turn() == ["a"]
    assert fleet.turn() == ["n2"]
    assert [fleet.turn() for _ in range(50)] == [[]] * 50
    assert fleet.turn(10.0) == ["b"]


def test_an_overloaded_node_keeps_its_only_stream():
    fleet = Fleet(Node("n1", 1.0), a=Desired("1", 1.0))
    fleet.turn()
    fleet.nodes = {"n1": Node("n1", 1.0, overloaded=True), "n2": Node("n2", 4.0)}
    assert fleet.turn() == []


def test_a_removed_stream_occupies_its_cores_until_it_is_gone():
    fleet = Fleet(Node("n1", 1.0), b=Desired("1", 1.0))
    fleet.actors["a"] = Actor("n1", "1", "stopping", 0.0, cores=1.0)
    assert fleet.turn() == []
    del fleet.actors["a"]
    assert fleet.turn() == ["n1"]


def test_a_pin_ends_if_the_source_cannot_be_opened_there():
    fleet = Fleet(Node("n1", 1.0), Node("n2", 2.0), a=Desired("1", 1.0, pinned="n2"))
    fleet.unopenable = {"n2"}
    assert fleet.turn() == ["n2"]
    assert fleet.plan(0.5).unpinned == ["a"]


def test_a_stream_that_ended_is_started_again_only_if_it_is_changed():
    fleet = Fleet(Node("n1", 2.0), Node("n2", 2.0), a=Desired("1", 1.0))
    fleet.turn()
    fleet.actors["a"] = replace(fleet.actors["a"], phase="ended")
    assert fleet.turn() == []
    fleet.change_node("n1", alive=False)
    fleet.actors.clear()
    assert fleet.turn() == []
    fleet.change("a", digest="2")
    assert fleet.turn() == ["n2"]


def test_an_actor_that_vanishes_without_its_node_counts_as_failed():
    fleet = Fleet(Node("n1", 2.0), a=Desired("1", 1.0))
    fleet.turn()
    del fleet.actors["a"]
    assert fleet.turn() == []
    assert fleet.turn(1.0) == ["n1"]


@pytest.mark.parametrize("phase", ["starting", "running", "stopping"])
def test_a_manager_that_starts_anew_adopts_what_is_there(phase):
    fleet = Fleet(Node("n1", 2.0), a=Desired("1", 1.0))
    fleet.actors["a"] = Actor("n1", "1", phase, 0.0)
    assert fleet.turn() == []

"""What the page of a fleet shows, and what it is told: a pure function of the status."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as some

from catstream.messages.kinds import FleetStatus, NodeStatus, StreamStatus
from catstream.web.fleet_dashboard import FleetDashboard, in_order, stream_card

NORTH = NodeStatus("north-1", "alive", "10.0.0.2", 4.0, 1.5, {"site": "north"}, 2)


def status(*streams, nodes=(NORTH,)):
    return FleetStatus("site", 1.7e9, {each.name: each for each in streams}, {each.name: each for each in nodes})


def told(dashboard, known):
    """The updates as a browser gets them."""
    return json.loads(json.dumps(dashboard.updates(known)))


def test_streams_in_trouble_are_first_and_the_rest_is_sorted_by_name_and_number():
    streams = [
        StreamStatus("cam-10", "running"),
        StreamStatus("cam-9", "ended"),
        StreamStatus("cam-3", "running", trouble="the store is full"),
        StreamStatus("cam-20", "unplaced"),
        StreamStatus("cam-4", "failed", trouble="the source cannot be opened"),
        StreamStatus("Aisle", "paused"),
    ]
    assert in_order({each.name: each for each in streams}) == ["cam-4", "cam-20", "cam-3", "Aisle", "cam-9", "cam-10"]


@pytest.mark.parametrize("word", ["cam-7", "waiting", "north-1", "site=north", "anna", "2024"])
def test_a_stream_is_found_by_name_state_node_label_and_object(word):
    card = stream_card(StreamStatus("Cam-7", "waiting", "north-1", models={"Anna": 3, "object.2024": 1}), NORTH)
    assert word in card["words"]


def test_a_page_is_told_only_the_fields_that_have_changed():
    dashboard, known = FleetDashboard(), {}
    before = StreamStatus("cam-7", "running", "north-1", rate=24.6, models={"anna": 3}, stored_seconds=0.5)
    other = StreamStatus("cam-8", "running", "north-1", rate=25.0)
    dashboard.take(status(before, other), 0.0)
    assert set(told(dashboard, known)) == {"fleet", "order", "streams", "nodes"}
    steady = StreamStatus("cam-7", "running", "north-1", rate=25.4, models={"anna": 3}, stored_seconds=4.5)
    dashboard.take(status(steady, other), 1.0)
    assert told(dashboard, known) == {}, "a frame rate and an age of the state that look the same"
    late = StreamStatus("cam-7", "running", "north-1", rate=25.4, models={"anna": 4}, stored_seconds=12.0)
    dashboard.take(status(late, other), 2.0)
    assert told(dashboard, known) == {"streams": {"cam-7": {"models": [["anna", 4]], "stored": 15}}}


def test_a_stream_that_moves_keeps_its_card():
    dashboard, known = FleetDashboard(), {}
    south = NodeStatus("south-1", "alive")
    dashboard.take(status(StreamStatus("cam-7", "running", "north-1"), nodes=(NORTH, south)), 0.0)
    dashboard.updates(known)
    dashboard.take(status(StreamStatus("cam-7", "moving", "south-1"), nodes=(NORTH, south)), 1.0)
    assert told(dashboard, known) == {
        "streams": {"cam-7": {"state": "moving", "node": "south-1", "words": "cam-7 moving south-1"}}
    }


def test_the_last_status_is_kept_with_its_age_while_the_fleet_does_not_answer():
    dashboard, known = FleetDashboard(), {}
    dashboard.mark_silent("no fleet of yours is running", 5.0)
    assert told(dashboard, known)["fleet"] == {
        "name": "", "phase": "waiting", "reason": "no fleet of yours is running", "age": 0,
    }  # fmt: skip
    dashboard.take(status(StreamStatus("cam-7", "running")), 10.0)
    dashboard.updates(known)
    dashboard.mark_silent("no answer", 17.5)
    assert told(dashboard, known) == {"fleet": {"name": "site", "phase": "silent", "reason": "no answer", "age": 7}}
    assert "cam-7" in dashboard.updates({})["streams"]
    dashboard.take(status(StreamStatus("cam-7", "running")), 18.0)
    assert told(dashboard, known) == {"fleet": {"name": "site", "phase": "running", "reason": "", "age": 0}}


def test_an_empty_fleet_has_an_empty_order():
    dashboard = FleetDashboard()
    dashboard.take(status(nodes=()), 0.0)
    assert dashboard.updates({})["order"] == []


names = some.sampled_from(["cam-1", "cam-2", "cam-10"])
streams = some.builds(
    StreamStatus,
    names,
    some.sampled_from(["running", "failed", "moving"]),
    some.sampled_from(["", "north-1"]),
    rate=some.floats(0, 99),
    trouble=some.sampled_from(["", "it is late"]),
    stored_seconds=some.none() | some.floats(0, 9999),
)


@given(some.lists(some.tuples(some.lists(streams), some.booleans())))
def test_a_page_that_applies_its_updates_shows_what_a_new_page_shows(history):
    dashboard, known, shown = FleetDashboard(), {}, {"streams": {}, "nodes": {}}
    for now, (present, asked) in enumerate(history):
        dashboard.take(status(*present, nodes=(NORTH,) if len(present) % 2 else ()), float(now))
        if not asked:
            continue
        parts = told(dashboard, known)
        for part in ("streams", "nodes"):
            for name, change in parts.pop(part, {}).items():
                shown[part][name] = None if change is None else {**(shown[part].get(name) or {}), **change}
        shown |= parts
        alive = {name: card for name, card in shown["streams"].items() if card is not None}
        nodes = {name: row for name, row in shown["nodes"].items() if row is not None}
        new = {"streams": {}, "nodes": {}} | told(dashboard, {})
        assert shown | {"streams": alive, "nodes": nodes} == new

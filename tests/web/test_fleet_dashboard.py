"""What the page of a fleet is told: a pure function of the status."""

from __future__ import annotations

import json

import pytest

from catstream.messages.kinds import FleetStatus, NodeStatus, StreamStatus
from catstream.web.dashboard import FleetDashboard

NORTH = NodeStatus("north-1", "alive", "10.0.0.2", 4.0, 1.5, {"site": "north"}, 2)


@pytest.fixture
def dashboard():
    return FleetDashboard()


def status(*streams, nodes=(NORTH,)):
    return FleetStatus("site", 1.7e9, {each.name: each for each in streams}, {each.name: each for each in nodes})


def told(dashboard, seen):
    """The updates as a browser gets them."""
    return json.loads(json.dumps(dashboard.updates(seen)))


def test_a_page_is_told_of_all_streams_and_nodes_once_for_each_status(dashboard):
    seen = {}
    assert "streams" in told(dashboard, seen), "a new page is told which page it is, before the first status"
    dashboard.take(status(StreamStatus("cam-7", "running"), StreamStatus("cam-8", "failed", trouble="no source")), 0.0)
    first = told(dashboard, seen)
    assert (list(first["streams"]), first["streams"]["cam-8"]["trouble"]) == (["cam-7", "cam-8"], "no source")
    assert first["nodes"]["north-1"]["labels"] == {"site": "north"}
    assert told(dashboard, seen) == {}
    dashboard.take(status(StreamStatus("cam-7", "running"), nodes=()), 1.0)
    assert (list(told(dashboard, seen)["streams"]), told(dashboard, {})["nodes"]) == (["cam-7"], {})


def test_no_address_nor_key_of_a_pipeline_is_told(dashboard):
    secret = StreamStatus("cam-7", "running", endpoint="/tmp/secret-place", server="a public key")
    dashboard.take(status(secret), 0.0)
    assert "secret-place" not in str(told(dashboard, {}))
    assert "public key" not in str(told(dashboard, {}))


def test_the_objects_of_a_stream_are_in_the_order_in_which_they_began(dashboard):
    dashboard.take(status(StreamStatus("cam-7", "running", models={"ben": 3, "2024": 1, "anna": 2})), 0.0)
    assert told(dashboard, {})["streams"]["cam-7"]["models"] == [["ben", 3], ["2024", 1], ["anna", 2]]


def test_the_last_status_is_kept_with_its_age_while_the_fleet_does_not_answer(dashboard):
    seen = {}
    dashboard.mark_silent("no fleet of yours is running", 5.0)
    assert told(dashboard, seen)["status"] == {
        "name": "", "phase": "waiting", "reason": "no fleet of yours is running", "age": 0,
    }  # fmt: skip
    dashboard.take(status(StreamStatus("cam-7", "running")), 10.0)
    dashboard.updates(seen)
    dashboard.mark_silent("no answer", 17.5)
    assert told(dashboard, seen) == {"status": {"name": "site", "phase": "silent", "reason": "no answer", "age": 7}}
    assert "cam-7" in dashboard.updates({})["streams"]
    dashboard.take(status(StreamStatus("cam-7", "running")), 18.0)
    assert told(dashboard, seen)["status"] == {"name": "site", "phase": "running", "reason": "", "age": 0}

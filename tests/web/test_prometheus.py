"""The metrics of a pipeline and of a fleet."""

import re

import pytest

from catstream.messages.kinds import Health
from catstream.web import prometheus
from catstream.web.feed import FleetFeed, PipelineFeed


@pytest.fixture
def feed():
    return PipelineFeed()


def samples(feed):
    """The samples by metric: the labels and value of each."""
    found = {}
    lines = r"^(catstream_\w+)(?:\{(.*)\})? (.*)"
    for name, labels, value in re.findall(lines, prometheus.text(feed).decode(), re.MULTILINE):
        found.setdefault(name, []).append((labels, float(value)))
    return found


def test_each_counter_of_a_process_is_a_metric_with_the_object_as_its_label(feed, facts):
    report = facts.tracking(6.0, "anna", "ben")
    report.counters.update(taken=5.0, model_version=3.0)
    learned = {"anna": {"rows": 3.0, "loss_leaves": 1.0}, "ben": {"rows": 4.0, "loss_leaves": 2.0}}
    feed.dashboard.take(report, 0.0)
    feed.dashboard.take(Health("compressor", 1.0, {"rows": 7.0, "stored": 4.0}, objects=learned), 0.0)
    feed.dashboard.take(Health("trainer", 1.0, {"rejected": 2.0}, objects={"": {"trained": 5.0}}), 0.0)
    found = samples(feed)
    assert found["catstream_detector_sent"] == [("", 6.0)]
    assert found["catstream_compressor_stored"] == [("", 4.0)]
    assert found["catstream_detector_score"] == [('object="anna"', 0.75), ('object="ben"', 0.75)]
    assert found["catstream_compressor_rows"] == [('object="anna"', 3.0), ('object="ben"', 4.0)], "no sum among them"
    assert found["catstream_trainer_trained"] == [('object=""', 5.0)]
    assert found["catstream_trainer_age_seconds"][0][1] > 0


def test_a_pipeline_that_does_not_run_has_no_old_values(feed, facts):
    feed.dashboard.take(facts.tracking(6.0, "anna"), 0.0)
    assert "catstream_detector_score" in samples(feed)
    feed.dashboard.mark_silent("nothing came", 5.0)
    assert samples(feed) == {"catstream_up": [("", 0.0)], "catstream_viewers": [("", 0.0)]}
    feed.dashboard.take(facts.track(7, name="anna"), 6.0)
    assert samples(feed)["catstream_up"] == [("", 1.0)]


def test_each_number_of_a_stream_and_of_a_node_is_a_metric_with_their_names_as_labels(fleet):
    feed = FleetFeed(fleet.address)
    fleet.stream("cam-7", node="north", models={"anna": 3}, frame=25)
    fleet.stream("cam-8", "failed", trouble="no source")
    fleet.node("north", cores=4.0)
    feed.dashboard.take(fleet.status(), 0.0)
    found = samples(feed)
    assert found["catstream_stream_frame"] == [('node="north",stream="cam-7"', 25.0), ('node="",stream="cam-8"', 0.0)]
    assert found["catstream_stream_state"][1] == ('node="",state="failed",stream="cam-8"', 1.0)
    assert [value for _, value in found["catstream_stream_trouble"]] == [0.0, 1.0]
    assert found["catstream_stream_model_version"] == [('node="north",object="anna",stream="cam-7"', 3.0)]
    assert found["catstream_node_cores"] == [('node="north"', 4.0)]

"""The metrics of a pipeline and of a fleet."""

import re
from dataclasses import replace
from time import time

import pytest
from prometheus_client.parser import text_string_to_metric_families

from catstream.base.settings import Settings
from catstream.client.address import Address
from catstream.coreset.forest import Forest
from catstream.web import prometheus
from catstream.web.feed import PipelineFeed
from catstream.web.latency import Latency
from catstream.wire.messages import Health


@pytest.fixture
def feed():
    return PipelineFeed(Address())


def samples(of):
    """The samples by metric: the labels and value of each."""
    found = {}
    lines = r"^(catstream_\w+)(?:\{(.*)\})? (.*)"
    for name, labels, value in re.findall(lines, prometheus.response(of).body.decode(), re.MULTILINE):
        found.setdefault(name, []).append((labels, float(value)))
    return found


def test_counter_of_a_process_is_a_metric_labelled_by_object(feed, facts):
    report = replace(facts.tracking(6.0, "anna", "ben"), source="rtsp://door/1")
    report.counters.update(processed=5.0, model_version=3.0)
    learned = {"anna": {"rows": 3.0, "loss_leaves": 1.0}, "ben": {"rows": 4.0, "loss_leaves": 2.0}}
    feed.dashboard.take(report, 0.0)
    feed.dashboard.take(Health("compressor", 1.0, {"rows": 7.0}, objects=learned), 0.0)
    found = samples(prometheus.of_pipeline(feed))
    of, anna, ben = (f'{name}source="rtsp://door/1"' for name in ("", 'object="anna",', 'object="ben",'))
    assert found["catstream_detector_sent_total"] == [(of, 6.0)]
    assert found["catstream_detector_score"] == [(anna, 0.75), (ben, 0.75)]
    assert found["catstream_compressor_rows_total"] == [(anna, 3.0), (ben, 4.0)], "no sum among them"
    assert found["catstream_compressor_age_seconds"][0][1] > 0


def test_metric_has_its_own_type_and_help(feed, facts, fleet):
    report = facts.tracking(6.0, "anna")
    report.counters.update(dict.fromkeys(("processed", "stored", "skipped", "reconnects", "rejected", "rate"), 1.0))
    feed.dashboard.take(report, 0.0)
    feed.dashboard.take(Health("compressor", 1.0, Forest(Settings()).counters()), 0.0)
    fleet.stream("cam-7", node="north")
    fleet.node("north")
    of_pipeline = prometheus.response(prometheus.of_pipeline(feed), feed.latency.histogram)
    texts = of_pipeline.body.decode(), prometheus.response(prometheus.of_fleet(fleet.status())).body.decode()
    families = {family.name: family for text in texts for family in text_string_to_metric_families(text)}
    assert families["catstream_detector_sent"].type == families["catstream_compressor_frames"].type == "counter"
    assert families["catstream_detector_score"].type == families["catstream_detector_rate"].type == "gauge"
    assert families["catstream_track_latency_seconds"].type == "histogram"
    assert [name for name, family in families.items() if family.documentation.startswith("A counter of")] == []


def test_latency_counts_from_the_arrival_of_the_frame_in_its_run(facts):
    latency = Latency()
    latency.take(facts.track(5), "run")  # when its frame arrived is not known yet
    latency.take(Health("detector", 1.0, {"zero_time": time() - 2.0}), "run")
    latency.take(facts.track(19), "run")
    latency.take(facts.track(20), "another run")
    (family,) = latency.histogram.collect()
    found = {sample.name.rpartition("_")[2]: sample.value for sample in family.samples}
    assert found["count"] == 1
    assert 0.1 <= found["sum"] < 5


def test_silent_pipeline_has_no_old_values(feed, facts):
    feed.dashboard.take(facts.tracking(6.0, "anna"), 0.0)
    assert "catstream_detector_score" in samples(prometheus.of_pipeline(feed))
    feed.dashboard.mark_silent("nothing came")
    assert samples(prometheus.of_pipeline(feed)) == {
        "catstream_up": [('source=""', 0.0)],
        "catstream_state": [('source="",state="silent"', 1.0)],
        "catstream_viewers": [("", 0.0)],
    }
    feed.dashboard.take(facts.track(7, name="anna"), 6.0)
    assert samples(prometheus.of_pipeline(feed))["catstream_up"] == [('source=""', 1.0)]


@pytest.mark.parametrize(
    ("counters", "state", "paused", "lost"),
    [
        ({}, "running", 0.0, 0.0),
        ({"paused": 1.0}, "paused", 1.0, 0.0),
        ({"lost_seconds": 12.0, "paused": 1.0}, "lost", 1.0, 12.0),
    ],
)
def test_state_pause_and_lost_source_are_metrics(feed, counters, state, paused, lost):
    feed.dashboard.take(Health("detector", 1.0, {"sent": 6.0, **counters}), 0.0)
    found = samples(prometheus.of_pipeline(feed))
    assert found["catstream_state"] == [(f'source="",state="{state}"', 1.0)]
    assert [found[f"catstream_{name}"][0][1] for name in ("paused", "source_lost_seconds")] == [paused, lost]


def test_numbers_of_streams_and_nodes_are_labelled_by_name(fleet):
    fleet.stream("cam-7", node="north", models={"anna": 3}, frame=25, present={"anna": True, "ben": False})
    fleet.stream("cam-8", "failed", trouble="no source")
    fleet.node("north", cores=4.0)
    found = samples(prometheus.of_fleet(fleet.status()))
    assert found["catstream_stream_frame"] == [('node="north",stream="cam-7"', 25.0), ('node="",stream="cam-8"', 0.0)]
    assert found["catstream_stream_state"][1] == ('node="",state="failed",stream="cam-8"', 1.0)
    assert [value for _, value in found["catstream_stream_trouble"]] == [0.0, 1.0]
    assert found["catstream_stream_model_version"] == [('node="north",object="anna",stream="cam-7"', 3.0)]
    assert found["catstream_fleet_objects_present"] == [
        ('object="anna",stream="cam-7"', 1.0), ('object="ben",stream="cam-7"', 0.0)
    ]  # fmt: skip
    assert found["catstream_node_cores"] == [('node="north"', 4.0)]

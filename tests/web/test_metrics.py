"""The metrics of a pipeline and of a fleet, and the documents about them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from catstream.messages.kinds import Health
from catstream.web import metrics
from catstream.web.feed import PipelineFeed
from catstream.web.streams import FleetFeed

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def of_pipeline(facts):
    """The samples of a pipeline that tracks two objects in a live source, by metric: the labels and value of each."""
    feed = PipelineFeed()
    names, trees = ("anna", "ben"), ("object", "background", "loss", "extent", "size", "aspect")
    report = facts.tracking(6.0, *names)
    report.counters.update(taken=5.0, stored=4.0, skipped=1.0, lost_seconds=0.0, reopened=0.0)
    learned = {
        name: {"rows": rows, "bytes": 9.0} | {f"{tree}_leaves": rows - 2 for tree in trees}
        for name, rows in zip(names, (3.0, 4.0), strict=True)
    }
    trained = {"ben": {"trained": 5.0}, "forgotten": {"trained": 6.0}}
    feed.dashboard.take(report, 0.0)
    feed.dashboard.take(Health("compressor", 1.0, {}, objects=learned), 0.0)
    feed.dashboard.take(Health("trainer", 1.0, {}, objects=trained), 0.0)
    for name in names:
        feed.dashboard.take(facts.track(5, name=name), 0.0)
        feed.dashboard.take(facts.model(1, 5, name), 0.1)
    return samples(feed)


@pytest.fixture
def of_fleet(fleet):
    """The same of a fleet of one stream and one node."""
    feed = FleetFeed(fleet.address)
    fleet.stream("cam-7", node="north", models={"anna": 3}, stored_seconds=2.0)
    fleet.node("north", cores=4.0)
    feed.dashboard.take(fleet.status(), 0.0)
    return samples(feed)


def samples(feed):
    found = {}
    text = metrics.text(feed).decode()
    for name, some, value in re.findall(r"^(catstream_\w+)(?:\{(.*)\})? (.*)", text, re.MULTILINE):
        found.setdefault(name, []).append((some, float(value)))
    return found


def labels(found):
    return {name: set(re.findall(r"(\w+)=", some[0][0])) for name, some in found.items()}


def test_a_pipeline_that_does_not_run_has_no_old_values(facts):
    feed = PipelineFeed()
    feed.dashboard.take(facts.tracking(6.0, "anna"), 0.0)
    assert "catstream_score" in samples(feed)
    feed.dashboard.mark_silent("nothing came", 5.0)
    assert samples(feed) == {"catstream_up": [("", 0.0)], "catstream_viewers": [("", 0.0)]}
    feed.dashboard.take(facts.track(7, name="anna"), 6.0)
    assert samples(feed)["catstream_up"] == [("", 1.0)]


def test_the_frames_of_a_run_do_not_begin_again_at_0_while_its_detector_is_restarted(facts):
    feed = PipelineFeed()
    for sent in (6.0, 0.0):
        report = facts.tracking(sent, "anna")
        report.counters.update(stored=sent, skipped=sent)
        feed.dashboard.take(report, 0.0)
    found = samples(feed)
    assert found["catstream_frames_skipped_total"] == [("", 0.0)], "those of the new detector"
    assert not {"catstream_frames_total", "catstream_features_stored_total"} & found.keys()


@pytest.mark.parametrize("kind", ["pipeline", "fleet"])
def test_the_page_documents_each_metric_with_its_labels(kind, request):
    page = (DOCS / "how-to" / "view.md").read_text()
    table = page.partition(f"| metric of a {kind} |")[2].partition("\n\n")[0]
    documented = re.findall(r"`(catstream_\w+)(?:\{([\w,]+)\})?`", table)
    told = labels(request.getfixturevalue(f"of_{kind}"))
    assert {name: set(filter(None, text.split(","))) for name, text in documented} == told


def test_what_is_counted_for_each_object_has_its_name_as_a_label(of_pipeline, of_fleet):
    assert of_pipeline["catstream_objects"] == [("", 2.0)]
    assert of_pipeline["catstream_score"] == [('object="anna"', 0.75), ('object="ben"', 0.75)]
    assert ('object="ben"', 1.0) in of_pipeline["catstream_present"]
    assert ('object="ben"', 1.0) in of_pipeline["catstream_model_version"]
    assert of_pipeline["catstream_rows_total"] == [('object="anna"', 3.0), ('object="ben"', 4.0)]
    assert ('object="ben",tree="object"', 2.0) in of_pipeline["catstream_tree_leaves"]
    assert of_pipeline["catstream_models_trained_total"] == [('object="ben"', 5.0)]
    assert of_fleet["catstream_model_version"] == [('node="north",object="anna",stream="cam-7"', 3.0)]


def test_the_dashboard_of_grafana_asks_for_metrics_and_labels_that_exist(of_pipeline):
    panels = json.loads((DOCS / "grafana.json").read_text())["panels"]
    asked = re.findall(
        r"(catstream_\w+)\{(.*?)\}", " ".join(each["expr"] for panel in panels for each in panel["targets"])
    )
    assert len(asked) > 10
    for name, text in asked:
        of_object = {"object"} & labels(of_pipeline)[name]
        assert set(re.findall(r"(\w+)=~", text)) == {"instance"} | of_object, name

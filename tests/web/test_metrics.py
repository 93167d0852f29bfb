"""The metrics of a pipeline, and the documents about them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from catstream.messages.kinds import Health
from catstream.web import metrics
from catstream.web.feed import PipelineFeed

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def labels(facts):
    """The labels of each metric, by name, of a pipeline that tracks two objects in a live source."""
    feed = PipelineFeed()
    names, trees = ("anna", "ben"), ("object", "background", "loss", "extent", "size", "aspect")
    report = facts.tracking(6.0, *names)
    report.counters.update(taken=5.0, stored=4.0, skipped=1.0, lost_seconds=0.0, reopened=0.0)
    learned = {"rows": 1.0, "bytes": 1.0} | {f"{tree}_leaves": 1.0 for tree in trees}
    feed.dashboard.take(report, 0.0)
    feed.dashboard.take(Health("compressor", 1.0, {}, objects=dict.fromkeys(names, learned)), 0.0)
    feed.dashboard.take(Health("trainer", 1.0, {}, objects={name: {"trained": 1.0} for name in names}), 0.0)
    for name in names:
        feed.dashboard.take(facts.track(5, name=name), 0.0)
        feed.dashboard.take(facts.model(1, 5, name), 0.1)
    samples = re.findall(r"^(catstream_\w+)(?:\{(.*)\})? ", metrics.text(feed).decode(), re.MULTILINE)
    return {name: tuple(re.findall(r"(\w+)=", text)) for name, text in samples}


def test_the_page_documents_each_metric_with_its_labels(labels):
    text = (DOCS / "how-to" / "view.md").read_text()
    documented = re.findall(
        r"`(catstream_\w+)(?:\{([\w,]+)\})?`", text.partition("| metric of a pipeline |")[2].partition("\n\n")[0]
    )
    assert {name: tuple(filter(None, text.split(","))) for name, text in documented} == labels


def test_the_dashboard_of_grafana_asks_for_metrics_and_labels_that_exist(labels):
    panels = json.loads((DOCS / "grafana.json").read_text())["panels"]
    asked = re.findall(
        r"(catstream_\w+)\{(.*?)\}", " ".join(each["expr"] for panel in panels for each in panel["targets"])
    )
    assert len(asked) > 10
    for name, text in asked:
        assert set(re.findall(r"(\w+)=~", text)) == {"instance"} | ({"object"} & set(labels[name])), name

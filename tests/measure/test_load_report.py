"""The report: the figures and the limits that were not met, on one page that needs nothing else."""

import json

import pytest

from catstream.measure.load_report import to_json, write_report
from catstream.measure.load_result import Limit
from catstream.measure.load_test import LoadTest


def test_a_search_shows_the_number_of_streams_and_the_steps(result, tmp_path):
    runs = [result(*[[seconds] * 50] * streams) for streams, seconds in ((1, 0.01), (4, 0.3), (2, 0.02))]
    load_test = LoadTest([Limit("p99", 0.1)], find=True, results=runs, highest=2)
    assert (load_test.result.plan.streams, load_test.violations) == (2, [])
    page = write_report(tmp_path / "report.html", load_test).read_text()
    assert "This machine serves 2 streams" in page
    assert (page.count(">met<"), page.count(">exceeded<")) == (2, 1)
    steps = to_json(load_test)["steps"]
    assert [(step["streams"], step["p99"]) for step in steps] == [(1, 0.01), (4, 0.3), (2, 0.02)]
    load_test = LoadTest([Limit("p99", 0.1)], find=True, results=runs[1:2])
    assert load_test.violations == ["no number of streams meets p99=0.1: the lowest tried was 4"]
    assert "No number of streams meets the limits" in write_report(tmp_path / "report.html", load_test).read_text()


@pytest.mark.parametrize(
    ("tracked", "told"),
    [
        (1.0, "Sustained: 2 streams of 25 frames/s, at most 0.0 %"),
        (0.8, "stream 0 skipped 20.0 % of its frames, the first after 4.0 s"),
    ],
)
def test_report_begins_with_whether_the_rate_was_sustained(result, tmp_path, tracked, told):
    run = result([0.01] * 50, [0.01] * 50, tracked=tracked)
    page = write_report(tmp_path / "report.html", LoadTest([], results=[run])).read_text()
    assert told in page
    assert page.index("ustained") < page.index("<h2>Streams</h2>")


def test_every_stream_and_process_has_its_row(result, tmp_path):
    usage, memory = {"detector 0": [0.5], "detector 1": [0.7]}, {"detector 0": 10**8, "detector 1": 2 * 10**8}
    run = result([0.01] * 50, [0.02] * 50, usage=usage, memory=memory, errors=["stream 1: <it> died"])
    assert [run.cost(number)[1] for number in (0, 1)] == [10**8, 2 * 10**8]
    page = write_report(tmp_path / "report.html", LoadTest([], results=[run])).read_text()
    for row in ("detector 0", "detector 1"):
        assert f'<td class="text">{row}</td>' in page
    assert "stream 1: &lt;it&gt; died" in page
    assert '<tr class="mean"><td class="text">all</td>' in page


def test_json_report_contains_only_valid_json(result):
    text = json.dumps(to_json(LoadTest([Limit("max", 0.001)], results=[result([0.01] * 5)])), allow_nan=False)
    figures = json.loads(text)
    assert figures["limits"] == {"max": {"value": 0.001, "met": False}}
    (stream,) = figures["streams"]
    assert stream["frames"] == 5
    assert stream["track"]["max"] == 0.01

"""The report: the figures and the limits that were not met, on one page that needs nothing else."""

import json
import re

import numpy as np

from catstream.measure.latency import REST, Reading, Receipts
from catstream.measure.load_report import to_json, verdict, write_raw, write_report
from catstream.measure.load_result import Limit
from catstream.measure.load_test import LoadTest
from catstream.measure.provenance import provenance

PROVENANCE = provenance(["catstream", "loadtest", "--limit", "p99=0.1", "rtsp://me:secret@camera/1"])


def test_a_search_shows_the_number_of_streams_and_the_steps(result, tmp_path):
    runs = [result(*[[seconds] * 50] * streams) for streams, seconds in ((1, 0.01), (4, 0.3), (2, 0.02))]
    load_test = LoadTest([Limit("p99", 0.1)], find="streams", results=runs)
    assert (load_test.result.plan.streams, load_test.sustained) == (2, True)
    page = write_report(tmp_path / "report.html", load_test, PROVENANCE).read_text()
    assert "Sustained: at most 2 streams" in page
    assert (page.count(">met<"), page.count(">exceeded<")) == (2, 1)
    steps = to_json(load_test, {})["steps"]
    assert [(step["streams"], step["p99"]) for step in steps] == [(1, 0.01), (4, 0.3), (2, 0.02)]
    load_test = LoadTest([Limit("p99", 0.1)], find="streams", results=runs[1:2])
    assert "Not sustained (p99): 4 streams" in write_report(tmp_path / "report.html", load_test, PROVENANCE).read_text()


def test_verdict_is_the_first_line_of_the_report_and_in_json(result, tmp_path):
    for tracked, words in ((1.0, "Sustained: 2 streams"), (0.8, "Not sustained (skipped): 2 streams")):
        run = result([0.01] * 50, [0.01] * 50, tracked=tracked)
        load_test = LoadTest(Limit.defaults(run.plan), results=[run])
        assert verdict(load_test).startswith(words)
        assert to_json(load_test, {})["sustained"] == (tracked == 1)
        page = write_report(tmp_path / "report.html", load_test, PROVENANCE).read_text()
        assert page.index(verdict(load_test)) < page.index("<h2>Streams</h2>")


def test_interrupted_search_says_at_least(result):
    runs = [result([0.01] * 50), result(*[[0.01] * 50] * 2, interrupted=True)]
    load_test = LoadTest([Limit("p99", 0.1)], find="streams", results=runs, interrupted=True)
    assert verdict(load_test).startswith("Interrupted: at least 1 stream: ")
    load_test.results.pop(0)
    assert verdict(load_test).startswith("Interrupted after 10.0 s: no verdict")


def test_report_has_its_command_and_a_row_for_each_process(result, tmp_path):
    cores, memory = {"detector 0": 0.5, "detector 1": 0.7, REST: 0.1}, {"detector 0": 10**8, "detector 1": 2 * 10**8}
    readings = [Reading(105.0, 1.0, cores, memory)]
    run = result([0.01] * 50, [0.02] * 50, readings=readings, errors=["stream 1: <it> died"])
    assert [run.cost(number)[1] for number in (0, 1)] == [10**8, 2 * 10**8]
    page = write_report(tmp_path / "report.html", LoadTest([], results=[run]), PROVENANCE).read_text()
    assert all(f'<td class="text">{row}</td>' in page for row in ("detector 0", "detector 1", "all"))
    assert "stream 1: &lt;it&gt; died" in page
    assert "<pre>catstream loadtest --limit p99=0.1 rtsp://camera/1</pre>" in page


def test_chart_has_a_point_for_each_second(result, tmp_path):
    run = result([0.1] * 50, subscribers=[Receipts(0, "tracks", np.full((2, 50), 0.2), [50, 50], [0, 0])])
    page = write_report(tmp_path / "report.html", LoadTest([], results=[run]), PROVENANCE).read_text()
    assert "<h2>Subscribers</h2>" in page
    curves = re.findall(r'points="([^"]*)"', page)
    assert {len(points.split()) for points in curves} == {5}


def test_raw_file_has_a_row_for_each_frame_and_receiver(result, tmp_path):
    receipts = Receipts(1, "tracks", np.array([[0.5, 0.25]]), [2], [0])
    write_raw(tmp_path / "raw.csv", result([0.1] * 2, [0.2] * 2, tracked=0.5, subscribers=[receipts]))
    head, *rows = (tmp_path / "raw.csv").read_text().splitlines()
    assert head == "stream,channel,subscriber,frame,due_seconds,tracked,latency_seconds"
    assert rows[:2] == ["0,tracks,,0,0.000000,1,0.100000", "0,tracks,,1,0.100000,0,0.100000"]
    assert rows[-1] == "1,tracks,0,1,0.100000,0,0.250000"
    assert len(rows) == 2 * 2 * 2 + 2


def test_json_report_contains_only_valid_json(result):
    text = json.dumps(to_json(LoadTest([Limit("max", 0.001)], results=[result([0.01] * 5)]), {}), allow_nan=False)
    figures = json.loads(text)
    assert figures["limits"] == {"max": {"value": 0.001, "met": False}}
    (stream,) = figures["streams"]
    assert stream["frames"] == 5
    assert stream["track"]["max"] == 0.01

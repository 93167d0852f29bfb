"""The report and the command: one file with all in it, and a table."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from catstream.applications.evaluation.accuracy import write_report, write_strips
from catstream.applications.evaluation.datasets import FIRST
from catstream.applications.evaluation.failures import failure_strip, worst_runs
from catstream.applications.evaluation.runs import EvaluationRun
from catstream.errors import ServiceError
from catstream.settings import Settings


def run_of(sequence, boxes, tracker: str = "catstream") -> EvaluationRun:
    return EvaluationRun(tracker, sequence, FIRST, boxes, np.ones(len(boxes)), np.full(len(boxes), 0.01))


@pytest.fixture
def lost(sequence, found) -> EvaluationRun:
    """Lost from frame 3 on."""
    boxes = found.copy()
    boxes[3:, :2] += 60
    return run_of(sequence, boxes)


def test_a_failure_strip_shows_the_frames_around_the_loss(lost):
    strip = failure_strip(lost)
    assert strip.first == 3
    assert strip.length == 9
    rows = [row for row, _ in strip.pictures]
    assert rows == [0, 3, 8, 11]
    assert all(jpeg.startswith(b"\xff\xd8") for _, jpeg in strip.pictures)


def test_only_failures_are_shown_and_the_worst_first(sequence, found, lost):
    good = run_of(sequence, np.where(np.isnan(sequence.boxes), np.nan, found))
    half = run_of(sequence, np.where(np.arange(12)[:, None] < 9, good.boxes, lost.boxes))
    assert worst_runs([good, half, lost], 5) == [lost, half]
    assert worst_runs([half, lost], 1) == [lost]


def test_the_report_is_self_contained(tmp_path, sequence, found, lost):
    path = write_report(
        tmp_path / "report.html",
        [run_of(sequence, found, "mil"), lost],
        Settings(coreset={"size": 32}),
        {"blur": ["walk"], "out of view": ["walk"]},
    )
    page = path.read_text()
    assert page.count("<svg") == 2
    assert "data:image/jpeg;base64," in page
    assert not re.search(r"(src|href)=\"(?!data:)|<script|@import|url\(", page)
    assert "coreset.size=32" in page
    assert page.count("<tr") == 1 + 2 + 2 + 1 + 2 * 2  # the sequences with the means, and the attributes


def test_the_worst_failures_of_each_tracker_are_shown_and_more_of_the_first(tmp_path, sequence, lost):
    def named(tracker: str) -> list[EvaluationRun]:
        sequences = [replace(sequence, name=f"{tracker}{number}") for number in range(4)]
        return [replace(lost, tracker=tracker, sequence=other) for other in sequences]

    page = write_report(tmp_path / "report.html", named("catstream") + named("mil"), Settings(), {}).read_text()
    assert len(re.findall(r"<b>catstream\d</b>, catstream: wrong for", page)) == 4
    assert len(re.findall(r"<b>mil\d</b>, mil: wrong for", page)) == 2


def test_a_page_of_film_strips_has_the_worst_runs_only(tmp_path, sequence, lost):
    runs = [replace(lost, sequence=replace(sequence, name=f"walk{number}")) for number in range(3)]
    page = write_strips(tmp_path / "strips.html", runs, 2).read_text()
    assert len(re.findall(r"<b>walk\d</b>, catstream: wrong for 9 frames from frame 3 on", page)) == 2
    assert "<table" not in page


def test_a_report_that_cannot_be_written_is_an_error(tmp_path, lost):
    with pytest.raises(ServiceError, match="cannot write"):
        write_report(tmp_path / "missing" / "report.html", [lost], Settings(), {})


def test_the_command_prints_a_table_and_writes_all(tmp_path, walk, succeed):
    out, file = tmp_path / "out", tmp_path / "numbers.json"
    attributes = tmp_path / "attributes.json"
    attributes.write_text('{"walk": ["blur"]}')
    files = ["--output", out, "--json", file, "--attributes", attributes]
    output, errors = succeed("evaluate", walk, *files, "--set", "coreset.size=32")
    assert re.search(r"walk +catstream +12 +0\.\d{3}", output)
    assert "report.html" in output + errors
    figures = json.loads(file.read_text())
    assert figures["mean"]["catstream"]["success"] > 0.7
    assert figures["attributes"]["blur"] == {"sequences": ["walk"], "mean": figures["mean"]}
    assert (out / "report.html").exists()
    assert (out / "catstream" / "walk.txt").exists()


def test_the_command_shows_the_spread_over_several_runs_and_counts_the_sequences_that_flip(tmp_path, walk, succeed):
    output, errors = succeed("evaluate", walk, "--jitter", 2, "--tracker", "mil", "--output", tmp_path)
    assert re.search(r"walk +mil +12 +0\.\d{3} ±0\.\d{3}", output)
    (sentence,) = re.findall(r"mil: [01] of 1 sequences flip with the first box", output + errors)  # MIL is random
    assert sentence in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--shifts", "--jitter", "2"), "--starts, --shifts and --jitter each choose the runs of a sequence: give one"),
        (("--starts", "2", "--shifts"), "--starts, --shifts and --jitter each choose the runs of a sequence: give one"),
        (("--attributes", "attributes.json"), "give --output or --json"),
    ],
)
def test_options_that_contradict_one_another_are_an_error(walk, fail, options, message):
    assert message in fail("evaluate", walk, *options)


def test_failed_runs_are_reported_after_the_table_of_the_others(tmp_path, walk, said):
    torn = tmp_path / "torn"
    shutil.copytree(walk, torn)
    (torn / "img" / "0012.png").unlink()
    file = tmp_path / "out.json"
    code, output, errors = said("evaluate", walk, torn, "--tracker", "mil", "--json", file)
    assert re.search(r"walk +mil +12 +0\.\d{3}", output)
    assert re.search(r"mil on torn: .* 1 frame too few", errors)
    assert (code, "1 of 2 runs" in errors.splitlines()[-1]) == (1, True)
    assert [row["name"] for row in json.loads(file.read_text())["sequences"]] == ["walk"]


def test_an_unwritable_json_path_is_an_error_before_the_work(tmp_path, walk, fail):
    for place in (tmp_path, tmp_path / "a" / "b"):
        error = fail("evaluate", walk, "--tracker", "mil", "--json", place)
        assert "give a file in a folder that exists" in error


def test_figures_replace_no_file_that_is_not_json(tmp_path, walk, fail):
    (tmp_path / "video.mp4").write_bytes(b"a video")
    error = fail("evaluate", walk, "--tracker", "mil", "--json", tmp_path / "video.mp4")
    assert "only a file whose name ends with .json is replaced" in error

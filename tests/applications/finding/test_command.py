"""`catstream find`: its files, its report, and what happens after Ctrl-C."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from catstream.applications.finding.log import SearchLog
from catstream.cli.find import find
from catstream.errors import CatstreamError


@pytest.fixture
def run(model_files, tmp_path):
    """Runs the command with both models; the results are in the folder `found`."""

    def command(*arguments):
        models = [word for file in model_files for word in ("--model", str(file))]
        with ExitStack() as stack:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                stack.callback(signal.signal, number, signal.getsignal(number))
            return CliRunner().invoke(find, [*models, "--output", str(tmp_path / "found"), *map(str, arguments)])

    return command


def rows(folder, name):
    with (folder / name).open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_files_agree_and_the_report_is_self_contained(run, video, tmp_path):
    done = run(video)
    assert done.exit_code == 0, done.output
    folder = tmp_path / "found"
    sightings, intervals = rows(folder, "sightings.csv"), rows(folder, "intervals.csv")
    (file,) = json.loads((folder / "found.json").read_text())["files"]
    assert (len(file["sightings"]), len(file["intervals"])) == (len(sightings), len(intervals))
    assert sum(int(interval["sightings"]) for interval in intervals) == len(sightings)
    assert {sighting["object"] for sighting in sightings} >= {"dahlia"}
    page = (folder / "report.html").read_text()
    assert page.count("data:image/jpeg") == len(intervals)
    assert not re.search(r'(?:src|href)="(?!data:)', page)


def test_a_command_that_was_interrupted_keeps_its_results_and_continues(run, video, tmp_path, monkeypatch):
    step, steps = SearchLog.step, []

    def interrupted(*arguments):
        steps.append(step(*arguments))
        if len(steps) == 4:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(SearchLog, "step", interrupted)
    stopped = run(video)
    assert stopped.exit_code == 130
    assert "the same command continues" in stopped.output
    early = rows(tmp_path / "found", "sightings.csv")
    assert early
    assert "searched in part" in (tmp_path / "found" / "report.html").read_text()

    assert run(video).exit_code == 0
    continued, count = rows(tmp_path / "found", "sightings.csv"), len(steps)
    assert continued[: len(early)] == early
    assert run(video).exit_code == 0
    assert len(steps) == count, "a complete file is not searched again"
    assert run(video, "--overwrite").exit_code == 0
    assert rows(tmp_path / "found", "sightings.csv") == continued


def test_a_damaged_file_is_reported_and_the_others_are_searched(run, video, tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no video")
    shutil.copy(video, tmp_path / "b.mp4")
    for _ in range(2):
        done = run(tmp_path / "a.mp4", tmp_path / "b.mp4")
        assert isinstance(done.exception, CatstreamError)
        assert "1 problem" in str(done.exception)
        assert "a.mp4' is not a video" in done.output
    assert {row["file"] for row in rows(tmp_path / "found", "sightings.csv")} == {str(tmp_path / "b.mp4")}
    assert "is not a video" in (tmp_path / "found" / "report.html").read_text()


@pytest.mark.parametrize("sizes", ["2,1", "0,1", "1", "a,b", "1,nan"])
def test_sizes_are_two_positive_numbers_in_order(run, video, sizes):
    done = run(video, "--sizes", sizes)
    assert done.exit_code == 2
    assert "the smaller one first" in done.output

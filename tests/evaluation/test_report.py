"""The report and the command: one file with all in it, what made it, and a table."""

import dataclasses
import json
import platform
import re
import shutil
import subprocess

import numpy as np
import pytest

from catstream.base.settings import Settings
from catstream.evaluation.accuracy import COUNTS, MEASURES, mean_of, rows_of, write_report
from catstream.evaluation.datasets import FIRST
from catstream.evaluation.runs import EvaluationRun
from catstream.reports import provenance as module
from catstream.reports.provenance import machine, provenance


def run_of(sequence, boxes, tracker: str = "catstream") -> EvaluationRun:
    return EvaluationRun(tracker, sequence, FIRST, boxes, np.ones(len(boxes)), np.full(len(boxes), 0.01))


def test_the_report_is_self_contained(tmp_path, sequence, found):
    runs = [run_of(sequence, found, "mil"), run_of(sequence, found)]
    attributes = {"walk": ["blur", "occlusion"]}
    page = write_report(tmp_path / "report.html", runs, Settings(coreset={"size": 32}), attributes).read_text()
    assert page.count("<svg") == 2
    assert not re.search(r"(src|href)=\"(?!data:)|<script|@import|url\(", page)
    assert "coreset.size=32" in page
    assert page.count("<tr") == 1 + 2 + 2 + 1 + 2 * 2  # the sequences with the means, and the attributes


def test_the_frames_without_a_reported_box_are_added_up_over_runs_and_sequences(tmp_path, sequence, found):
    boxes, other = found.copy(), dataclasses.replace(sequence, name="other")
    absent = np.flatnonzero(np.isnan(sequence.boxes[:, 0]))
    boxes[[0, *absent[:2]]] = np.nan
    runs = [run_of(sequence, found), run_of(sequence, boxes), run_of(other, boxes)]
    mean = mean_of(rows_of(runs))["catstream"]
    count = len(absent)
    assert [mean[each] for each in COUNTS] == [3 * count, 4, 3 * (12 - count), 2]
    page = write_report(tmp_path / "report.html", runs, Settings(), {}).read_text()
    assert f"2/{2 * count} {1 / count:.0%}" in page
    assert f"2/{3 * (12 - count)} " in page


def test_the_command_prints_a_table_and_writes_all(tmp_path, walk, succeed):
    out, file = tmp_path / "out", tmp_path / "numbers.json"
    attributes = tmp_path / "attributes.json"
    attributes.write_text('{"walk": ["blur"]}')
    files = ["--output", out, "--json", file, "--attributes", attributes]
    output, errors = succeed("evaluate", walk, *files, "--set", "coreset.size=32")
    assert re.search(r"walk +catstream +12 +0\.\d{3} .* \d/3 \d+(\.0)?% +0/9 0\.0%", output)
    assert "report.html" in output + errors
    figures = json.loads(file.read_text())
    assert figures["mean"]["catstream"].keys() == {*MEASURES, *COUNTS}
    assert figures["mean"]["catstream"]["success"] > 0.7
    assert figures["attributes"]["blur"] == {"sequences": ["walk"], "mean": figures["mean"]}
    assert (out / "report.html").exists()
    assert (out / "catstream" / "walk.txt").exists()


def test_the_command_shows_the_spread_over_runs_and_counts_sequences_that_flip(tmp_path, walk, succeed):
    output, errors = succeed("evaluate", walk, "--jitter", 2, "--tracker", "mil", "--output", tmp_path)
    assert re.search(r"walk +mil +12 +0\.\d{3} ±0\.\d{3}", output)
    (sentence,) = re.findall(r"mil: [01] of 1 sequences flip with the initial box", output + errors)  # MIL is random
    assert sentence in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--shifts", "--jitter", "2"), "--starts, --shifts, --jitter and --keyframes are mutually exclusive"),
        (("--attributes", "attributes.json"), "--attributes requires --output or --json"),
    ],
)
def test_options_that_contradict_one_another_are_an_error(walk, fail, options, message):
    assert message in fail("evaluate", walk, *options)


def test_failed_runs_are_reported_after_the_table_of_the_others(tmp_path, walk, said):
    for name in ("torn", "malformed"):
        shutil.copytree(walk, tmp_path / "all" / name)
    shutil.copytree(walk, tmp_path / "all" / "walk")
    (tmp_path / "all" / "torn" / "img" / "0012.png").unlink()
    (tmp_path / "all" / "malformed" / "groundtruth_rect.txt").write_text("1,2,3,4\n")
    file = tmp_path / "out.json"
    options = "--tracker", "mil", "--json", file, "--output", tmp_path / "out"
    code, output, errors = said("evaluate", tmp_path / "all", *options)
    assert re.search(r"walk +mil +12 +0\.\d{3}", output)
    page = (tmp_path / "out" / "report.html").read_text()
    for message in (r"mil on torn: .* fewer frames than boxes", r"malformed/groundtruth_rect.txt\S* has one box"):
        assert re.search(message, errors)
        assert re.search(message, page)
    assert (code, "2 of 3 runs" in errors.splitlines()[-1]) == (1, True)
    assert [row["name"] for row in json.loads(file.read_text())["sequences"]] == ["walk"]


def test_an_unfit_json_path_is_an_error_before_the_work(tmp_path, walk, fail):
    (tmp_path / "video.mp4").write_bytes(b"a video")
    for place, why in (
        (tmp_path, "pass a file in an existing folder"),
        (tmp_path / "a" / "b", "pass a file in an existing folder"),
        (tmp_path / "video.mp4", "only a file whose name ends with .json is replaced"),
    ):
        assert why in fail("evaluate", walk, "--tracker", "mil", "--json", place)


def test_a_report_that_cannot_be_written_is_an_error_of_one_line_after_the_table(tmp_path, walk, said):
    (tmp_path / "report.html").mkdir()
    code, output, errors = said("evaluate", walk, "--tracker", "mil", "--output", tmp_path)
    assert re.search(r"walk +mil +12", output)
    place = str(tmp_path / "report.html")
    assert (code, errors) == (1, f"catstream: cannot write {place!r} (Is a directory): use another folder\n")


def test_neither_command_nor_machine_tell_folders_or_the_host_name():
    made = provenance(Settings(coreset={"size": 32}), ["catstream", "/home/me/walk", "--data=/home/me/walk"])
    assert (made["command"], made["settings"]) == ("catstream walk --data=walk", ["coreset.size=32"])
    told = machine()
    assert {"processor", "cores", "memory_gb", "python", "opencv", "blas", "numpy"} <= told.keys()
    assert platform.node() not in json.dumps(told)
    assert (module._ROOT / "pyproject.toml").is_file(), "the commit is that of this checkout"


def test_the_commit_is_that_of_the_checkout_and_dirty_if_the_code_was_changed(tmp_path, monkeypatch):
    def git(*words):
        subprocess.run(["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", *words], check=True)

    monkeypatch.setattr(module, "_ROOT", tmp_path)
    assert provenance(Settings())["commit"] is None
    for folder in ("catstream", "benchmarks/results"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "catstream" / "code.py").touch()
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    commit = provenance(Settings())["commit"]
    (tmp_path / "benchmarks" / "results" / "speed.json").touch()
    assert provenance(Settings())["commit"] == commit
    (tmp_path / "catstream" / "code.py").write_text("changed")
    assert provenance(Settings())["commit"] == f"{commit}-dirty"

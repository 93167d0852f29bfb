"""`catstream find`: its files, its report, and what happens after Ctrl-C."""

import csv
import json
import os
import re
import shutil
import signal

import pytest

import catstream
from catstream.finding.results import FileResult


@pytest.fixture
def run(said, model_files, tmp_path):
    """Runs the command with both models; the results are in the folder `found`: exit code, output and errors."""
    models = [word for file in model_files for word in ("--model", file)]

    def command(*arguments):
        code, output, errors = said("find", *models, "--output", tmp_path / "found", *arguments)
        return code, output + errors

    return command


def rows(folder, name):
    with (folder / name).open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_files_agree_and_the_report_is_self_contained(run, video, tmp_path):
    code, output = run(video)
    assert code == 0, output
    folder = tmp_path / "found"
    detections, intervals = rows(folder, "detections.csv"), rows(folder, "intervals.csv")
    (file,) = json.loads((folder / "results.json").read_text())["files"]
    assert (len(file["detections"]), len(file["intervals"])) == (len(detections), len(intervals))
    assert sum(int(interval["detections"]) for interval in intervals) == len(detections)
    assert {detection["object"] for detection in detections} >= {"dahlia"}
    page = (folder / "report.html").read_text()
    assert page.count("data:image/jpeg") == len(intervals)
    assert not re.search(r'(?:src|href)="(?!data:)', page)


def test_a_command_that_was_interrupted_keeps_its_results_and_continues(run, video, tmp_path, monkeypatch):
    add, steps = FileResult.add, []

    def interrupted(*arguments):
        steps.append(add(*arguments))
        if len(steps) == 16:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(FileResult, "add", interrupted)
    files = [shutil.copy(video, tmp_path / name) for name in ("a.mp4", "b.mp4")]
    code, output = run(*files)
    assert code == 130
    assert "the same command continues" in output
    early = rows(tmp_path / "found", "detections.csv")
    assert {row["file"] for row in early} == {str(file) for file in files}
    assert "searched in part" in (tmp_path / "found" / "report.html").read_text()

    assert run(*files)[0] == 0
    continued, count = rows(tmp_path / "found", "detections.csv"), len(steps)
    assert count == 16 + 11, "only the second file is searched again"
    assert continued[: len(early)] == early
    assert run(*files)[0] == 0
    assert len(steps) == count, "a complete file is not searched again"
    assert run(*files, "--overwrite")[0] == 0
    assert rows(tmp_path / "found", "detections.csv") == continued


def test_a_damaged_file_is_reported_and_the_others_are_searched(run, video, tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no video")
    shutil.copy(video, tmp_path / "b.mp4")
    for _ in range(2):
        code, output = run(tmp_path / "a.mp4", tmp_path / "b.mp4")
        assert (code, "1 problem" in output) == (1, True)
        assert "a.mp4' is not a video" in output
    assert {row["file"] for row in rows(tmp_path / "found", "detections.csv")} == {str(tmp_path / "b.mp4")}
    assert "is not a video" in (tmp_path / "found" / "report.html").read_text()


def test_the_frames_of_a_video_that_are_skipped_are_counted(run, video, model_files, rng, tmp_path):
    data = bytearray(video.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 20_000] = rng.bytes(20_000)
    (tmp_path / "b.mp4").write_bytes(data)
    code, output = run(tmp_path / "b.mp4", "--skip-damaged")
    assert code == 1
    assert re.search(r"b.mp4' is damaged: [1-9]\d* of its frames were skipped", output)
    assert "frames were skipped" in (tmp_path / "found" / "report.html").read_text()
    assert list(catstream.find(model_files, tmp_path / "b.mp4", skip_damaged=True))


def test_a_name_that_is_not_utf_8_stays_in_the_tables_and_the_report(run, video, tmp_path):
    path = tmp_path / os.fsdecode(b"caf\xe9.mp4")
    shutil.copy(video, path)
    code, output = run(path)
    assert code == 0, output
    for name in ("detections.csv", "report.html"):
        assert b"caf\xe9.mp4" in (tmp_path / "found" / name).read_bytes()


@pytest.mark.parametrize("sizes", ["1", "a,b"])
def test_sizes_that_are_not_two_numbers_are_an_error(run, video, sizes):
    code, output = run(video, "--sizes", sizes)
    assert (code, "0.5,2" in output) == (2, True)

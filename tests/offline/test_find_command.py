"""`catstream find`: its files, its report, and Ctrl-C."""

import csv
import json
import os
import re
import shutil
import signal

import cv2
import pytest

from catstream.offline.find_results import FileResult


@pytest.fixture
def run(said, model_files, tmp_path):
    """Runs the command with both models; the results are in the folder `found`: exit code, output and errors."""
    models = [word for file in model_files for word in ("--model", file)]

    def command(*arguments):
        code, output, errors = said("find", *models, "--output", tmp_path / "found", *arguments)
        return code, output + errors

    return command


def rows(folder):
    with (folder / "detections.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def lines(folder):
    return [json.loads(line) for line in (folder / "results.ndjson").read_text().splitlines()]


def test_files_agree_and_the_report_is_self_contained(run, video, tmp_path):
    code, output = run(video)
    assert code == 0, output
    folder = tmp_path / "found"
    detections, (file,) = rows(folder), lines(folder)
    assert sum(len(interval["detections"]) for interval in file["intervals"]) == len(detections)
    assert {detection["object"] for detection in detections} >= {"dahlia"}
    page = (folder / "report.html").read_text()
    assert page.count("data:image/jpeg") == len(file["intervals"])
    assert not re.search(r'(?:src|href)="(?!data:)', page)


def test_interrupted_command_keeps_its_results_and_continues(run, video, tmp_path, monkeypatch):
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
    early = rows(tmp_path / "found")
    assert {row["file"] for row in early} == {str(files[0])}
    with (tmp_path / "found" / "results.ndjson").open("a") as stream:
        stream.write('{"file":"half a li')  # as if the process had been killed in a write

    assert run(*files)[0] == 0
    continued, count = rows(tmp_path / "found"), len(steps)
    assert count == 16 + 10, "only the second file is searched again"
    assert continued[: len(early)] == early
    assert [file["file"] for file in lines(tmp_path / "found")] == [str(file) for file in files]
    assert run(*files)[0] == 0
    assert len(steps) == count, "a searched file is not searched again"
    assert run(*files, "--overwrite")[0] == 0
    assert rows(tmp_path / "found") == continued


def test_results_of_another_search_are_not_replaced(run, video, tmp_path):
    assert run(video)[0] == 0
    file = tmp_path / "found" / "results.ndjson"
    before = file.read_bytes()
    code, output = run(video, "--threshold", 0.7)
    assert (code, "other models or options" in output) == (1, True)
    assert file.read_bytes() == before
    file.write_text("[]\n")
    code, output = run(video)
    assert (code, "has no results of a search" in output) == (1, True)
    assert file.read_text() == "[]\n"


def test_folder_with_new_images_is_searched_again(run, images, tmp_path):
    (folder := tmp_path / "photos").mkdir()
    for count in (1, 2):
        cv2.imwrite(str(folder / f"{count}.png"), images[count])
        assert run(folder)[0] == 0
        assert {row["image"] for row in rows(tmp_path / "found")} == {f"{number}.png" for number in range(1, count + 1)}


def test_damage_is_reported_and_other_files_are_searched(run, video, rng, tmp_path):
    data = bytearray(video.read_bytes())
    (tmp_path / "a.mp4").write_bytes(b"no video")
    data[len(data) // 2 : len(data) // 2 + 20_000] = rng.bytes(20_000)
    (tmp_path / "b.mp4").write_bytes(data)
    for _ in range(2):
        code, output = run(tmp_path / "a.mp4", tmp_path / "b.mp4")
        assert (code, "2 problems in 2 files" in output) == (1, True)
        assert "a.mp4' is not a video" in output
        assert re.search(r"b.mp4' is damaged: [1-9]\d* of its frames were skipped", output)
    assert {row["file"] for row in rows(tmp_path / "found")} == {str(tmp_path / "b.mp4")}
    assert "is not a video" in (tmp_path / "found" / "report.html").read_text()


def test_name_that_is_not_utf_8_is_in_table_and_report(run, video, tmp_path):
    path = tmp_path / os.fsdecode(b"caf\xe9.mp4")
    shutil.copy(video, path)
    code, output = run(path)
    assert code == 0, output
    for name in ("detections.csv", "report.html"):
        assert b"caf\xe9.mp4" in (tmp_path / "found" / name).read_bytes()

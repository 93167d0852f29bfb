"""`catstream summary`: of a folder, a recording and a video; bad input, and an interrupt."""

from __future__ import annotations

import json
import signal

import cv2
import numpy as np
import pytest

from catstream.applications.summaries import images
from catstream.messages.names import boxes_by_name
from catstream.run.job import Job


@pytest.fixture
def folder(tmp_path, rng):
    """Ten images of different sizes, one of them damaged."""
    (tmp_path / "photos").mkdir()
    for number in range(10):
        image = rng.integers(0, 256, (6, 8, 3), np.uint8)
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), cv2.resize(image, (60 + 9 * number, 50)))
    (tmp_path / "photos" / "7.png").write_bytes(b"no image")
    return tmp_path / "photos"


def test_the_images_of_a_folder_are_summarised_and_damaged_ones_named(folder, succeed, tmp_path):
    _, errors = succeed("summary", folder, "-k", 3, cwd=tmp_path)
    assert "skipped 7.png: not an image that can be read" in errors
    assert "3 of 9 images keep " in errors
    figures = json.loads((tmp_path / "summary.json").read_text())
    assert (figures["images"], len(figures["selected"]), len(figures["skipped"])) == (9, 3, 1)
    assert 0 < figures["kept"] <= figures["kept_at_most"] <= 1
    names = [each["file"] for each in figures["selected"]]
    assert names == sorted(names)
    page = (tmp_path / "summary.html").read_text()
    assert page.count("<img ") == 3
    assert all(f">{name}</b>" in page for name in names)
    assert "http" not in page


def test_the_frames_of_a_recording_are_shown_with_the_pictures_of_its_video(whole_run, succeed, tmp_path):
    succeed("summary", whole_run / "rec", "-k", 4, cwd=tmp_path)
    figures = json.loads((tmp_path / "summary.json").read_text())
    frames = [each["frame"] for each in figures["selected"]]
    assert len(frames) == 4
    assert frames[0] == 0
    assert frames == sorted(frames)
    assert (tmp_path / "summary.html").read_text().count("<img ") == 4


def test_the_frames_are_found_without_the_video(whole_run, succeed, tmp_path):
    _, errors = succeed("summary", whole_run / "rec", "-k", 4, "--source", tmp_path / "gone.mp4", cwd=tmp_path)
    assert "the sheet has no pictures: there is no video or folder" in errors
    assert (tmp_path / "summary.html").read_text().count("no picture</div>") == 4


def test_a_video_with_a_box_is_tracked(video, succeed, tmp_path):
    source, box = video
    _, errors = succeed("summary", source, "--box", box, "-k", 3, "--output", tmp_path / "frames.html")
    assert "The 3 of " in errors
    assert (tmp_path / "frames.html").read_text().count("<img ") == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames.html", "frames.json"]


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["photos", "-k", "20"], "k = 20 images cannot be selected from 9: give a smaller k"),
        (["empty"], "the folder 'empty' and its subfolders hold neither images nor videos"),
        (["photos", "--output", "no/where.html"], "give a file in a folder that exists"),
        (["photos", "--output", "some.json"], "give a name that ends in .html"),
        (["walk.mp4", "--output", "walk.mp4", "--overwrite"], "give a name that ends in .html"),
        (["photos", "--output", "old.html"], "old.html exists already: replace it with --overwrite"),
        (["0"], "0 is a live source: record it to a video first"),
    ],
)
def test_bad_input_is_an_error_of_one_line_and_nothing_is_written(arguments, problem, folder, fail, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "old.html").write_text("old")
    before = sorted(tmp_path.rglob("*"))
    assert problem in fail("summary", *arguments, cwd=folder.parent)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("path", "options", "problem"),
    [
        ("photos", ["--object", "anna"], "--object cannot be used with images, or a video without --box"),
        ("photos", ["--source", "walk.mp4"], "--source cannot be used with images"),
        ("photos", ["--set", "coreset.size=32"], "--settings, --preset or --set cannot be used with images"),
        ("photos", ["--box", "1,2,30,40", "--source", "walk.mp4"], "--source cannot be used with a video with --box"),
        ("rec", ["--box", "1,2,30,40"], "--box cannot be used with a recording: omit the option"),
        ("state", ["--box", "1,2,30,40"], "--box cannot be used with the folder of a run"),
    ],
)
def test_an_option_that_does_not_apply_is_an_error(path, options, problem, folder, whole_run, said):
    (folder.parent / "rec").symlink_to(whole_run / "rec")
    (folder.parent / "state").mkdir()
    Job("walk.mp4").save(folder.parent / "state")
    code, _, errors = said("summary", path, *options, cwd=folder.parent)
    assert code == 2
    assert problem in errors
    assert not (folder.parent / "summary.html").exists()


def test_the_video_of_a_run_may_have_moved(video, succeed, tmp_path):
    source, box = video
    Job("gone.mp4", boxes_by_name({"": box})).save(tmp_path)
    succeed("summary", tmp_path, "-k", 3, "--source", source, cwd=tmp_path)
    assert (tmp_path / "summary.html").read_text().count("<img ") == 3


def test_an_object_that_is_not_in_the_run_is_an_error(whole_run, fail, tmp_path):
    error = fail("summary", whole_run / "rec", "--object", "ben", cwd=tmp_path)
    assert "the objects of this run are: the object without a name; give one of them with --object NAME" in error


@pytest.mark.parametrize(("boxes", "began"), [({}, "none"), ({"anna": "1,2,30,40"}, "anna")])
def test_an_object_that_was_given_by_a_command_is_not_tracked_again(boxes, began, video, fail, tmp_path):
    Job(video[0], boxes_by_name(boxes)).save(tmp_path)
    error = fail("summary", tmp_path, *(["--object", "ben"] if boxes else []), cwd=tmp_path)
    assert f"the objects at the start of this run are: {began}; " in error
    assert "record the run with `catstream track --record`" in error


def test_an_interrupt_leaves_no_file(folder, said, tmp_path, monkeypatch):
    def interrupted(image):
        signal.raise_signal(signal.SIGTERM)
        return image

    monkeypatch.setattr(images, "describe", interrupted)
    code, _, errors = said("summary", folder, cwd=tmp_path)
    assert (code, errors) == (130, "stopped\n")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]

"""`catstream export`: other formats from the log of a run."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import pytest

from catstream.base.box import Box
from catstream.output.destinations import Header
from catstream.wire.messages import Track


def test_log_of_a_run_is_exported_to_other_formats(whole_run, video, succeed, fail, tmp_path):
    log = whole_run / "out" / "demo.csv"
    succeed("export", whole_run / "out" / "demo.ndjson", tmp_path / "t.sqlite")
    with closing(sqlite3.connect(tmp_path / "t.sqlite")) as database:
        assert [frame for (frame,) in database.execute("SELECT frame FROM tracks")] == list(range(32))
    succeed("export", log, tmp_path / "t.json", "--source", video[0], "--label", "person")
    coco = json.loads((tmp_path / "t.json").read_text())
    assert [each["name"] for each in coco["categories"]] == ["person"]
    assert (len(coco["images"]), coco["images"][0]["width"]) == (32, 320)
    assert "(--source)" in fail("export", log, tmp_path / "t.xml")
    assert "there is no video or folder" in fail("export", log, tmp_path / "t.xml", "--source", tmp_path / "none.mp4")
    assert "t.sqlite exists already: replace it with --overwrite" in fail("export", log, tmp_path / "t.sqlite")


def test_labels_of_a_data_set_are_replaced_only_on_request(whole_run, succeed, fail, tmp_path):
    command = ["export", whole_run / "out" / "demo.ndjson", tmp_path / "set", "--format", "yolo"]
    succeed(*command)
    label, other = (tmp_path / "set" / "labels" / name for name in ("demo_000000.txt", "other.txt"))
    for file in (label, other):
        file.write_text("corrected by hand")
    assert "is not empty: replace its labels with --overwrite" in fail(*command)
    assert label.read_text() == "corrected by hand"
    succeed(*command, "--overwrite")
    assert label.read_text() != "corrected by hand"
    assert not other.exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--classes", "a,,b"], "expected different names"),
        (["--label", "a\x01b"], "expected printable characters"),
        (["--format", "mot", "--classes", "a"], "--classes requires a format with classes"),
        (["--images"], "--images requires --format yolo"),
    ],
)
def test_invalid_options_of_an_export_are_an_error(whole_run, fail, tmp_path, options, words):
    assert words in fail("export", whole_run / "out" / "demo.ndjson", tmp_path / "t.xml", *options)
    assert not (tmp_path / "t.xml").exists()


def test_data_set_has_the_images_of_the_tracked_frames(whole_run, succeed, tmp_path):
    succeed("export", whole_run / "out" / "demo.ndjson", tmp_path / "set", "--format", "yolo", "--images")
    images, labels = (sorted((tmp_path / "set" / name).iterdir()) for name in ("images", "labels"))
    assert [file.stem for file in images] == [file.stem for file in labels]
    assert (len(images), cv2.imread(str(images[0])).shape) == (32, (240, 320, 3))


def test_source_of_another_size_is_an_error(whole_run, fail, tmp_path):
    log, annotated = whole_run / "out" / "demo.ndjson", whole_run / "out" / "demo.mp4"
    assert "has frames of (320, 240), not" in fail("export", log, tmp_path / "t.json", "--source", annotated)


def test_images_of_equal_names_are_all_in_the_data_set(walk, succeed, tmp_path):
    for name in ("monday", "tuesday"):
        shutil.copytree(walk / "img", tmp_path / name)
        track = Track(0, 0.0, "present", Box(10, 20, 30, 40), 0.9, 1, object="anna")
        header = Header(source=str(tmp_path / name), size=(320, 240))
        (tmp_path / f"{name}.ndjson").write_text(f"{header.to_json()}\n{json.dumps(track.to_dict())}\n")
    succeed("export", tmp_path, tmp_path / "set", "--format", "yolo", "--images")
    first = min(file.name for file in (walk / "img").iterdir())
    images = {file.name for file in (tmp_path / "set" / "images").iterdir()}
    assert images == {f"monday_{first}", f"tuesday_{first}"}
    labels = {file.stem for file in (tmp_path / "set" / "labels").iterdir()}
    assert labels == {Path(name).stem for name in images}

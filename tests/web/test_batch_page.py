"""The page of `catstream batch --ask` in a real browser: boxes are drawn in several videos, which are then tracked."""

import csv
import json
import os
import subprocess

import cv2
import pytest

from catstream.video.source import open_source

FRAMES, SIZE, LARGE = 6, (320, 240), (640, 360)

pytestmark = pytest.mark.system


@pytest.fixture
def videos(demo_video, tmp_path):
    """A video, one that cannot be read, and a folder of larger images, in a folder with a symbolic link to it."""
    video, boxes = demo_video(FRAMES)
    folder = tmp_path / "deep" / "videos"
    (folder / "images").mkdir(parents=True)
    (folder / "cam.mp4").write_bytes(video.read_bytes())
    (folder / "broken.mp4").write_bytes(video.read_bytes()[:1000])
    with open_source(video) as source:
        for frame in source:
            cv2.imwrite(str(folder / "images" / f"{frame.number}.png"), cv2.resize(frame.image, LARGE))
    (tmp_path / "link").symlink_to(folder)
    return [tmp_path / "link" / name for name in ("cam.mp4", "broken.mp4", "images")], boxes[0]


def test_boxes_of_several_videos_are_drawn_before_they_are_tracked(
    script_of_browser, catstream, said, videos, tmp_path
):
    files, box = videos
    out = tmp_path / "out"
    command = ["batch", "--ask", *files, "--output", out, "--jobs", 1, "--listen", 0]
    process = catstream(*command, env=os.environ | {"PYTHONUNBUFFERED": "1"})
    link = process.stdout.readline().strip()
    run = subprocess.run(
        script_of_browser("batch.mjs", link, json.dumps([SIZE, LARGE]), json.dumps(box)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert run.stdout.splitlines() == [
        "first ../deep/videos/cam.mp4 video 1 of 2",
        "second ../deep/videos/images video 2 of 2 | No other video: Done begins to track N",
        "shares 100%,50%",
        "violations []",
        "errors []",
    ]
    _, errors = process.communicate(timeout=150)
    assert process.returncode == 0, errors
    assert "broken.mp4' is not a video that can be read" in errors
    with (out / "boxes.csv").open() as file:
        drawn = [(row["file"], row["object"], row["frame"]) for row in csv.DictReader(file)]
    places = ("../deep/videos/cam.mp4", "../deep/videos/images")
    assert drawn == [(places[0], "anna", "0"), (places[0], "ben", "0"), (places[1], "anna", "0")]
    with (out / "batch.csv").open() as file:
        rows = {row["video"]: row for row in csv.DictReader(file)}
    assert [rows[place]["tracks"] for place in places] == [str(2 * FRAMES), str(FRAMES)]

    code, *_ = said("batch", out / "boxes.csv", "--output", tmp_path / "again", "--jobs", 1)
    assert code == 0
    log = "deep_videos_cam.csv"
    assert (tmp_path / "again" / log).read_text().count("anna") == (out / log).read_text().count("anna") == FRAMES

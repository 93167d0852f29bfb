"""What the libraries that people use read in the exports of real runs, beside the CSV file of the same run.

They are installed in `build/readers`, an environment of their own, by the first test: 2 GB, most of it PyTorch for
Ultralytics.
"""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from catstream.video.source import open_source

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
LIBRARIES = ["torch", "torchvision", "movement", "pycocotools", "supervision", "datumaro", "trackeval"]
BARE = ["ultralytics", "ultralytics-thop"]  # without their dependencies: only its data sets are used
READERS = {
    **{"ultralytics_yolo": "set", "supervision_yolo": "set", "pycocotools_coco": "walk.json"},
    **{"datumaro_cvat": "walk.xml", "trackeval_mot": "walk.txt", "movement_via": "walk.via.csv"},
}


@pytest.fixture(scope="session")
def libraries():
    """The Python of an environment with the libraries, which is made once."""
    folder = ROOT / "build" / "readers"
    if not (folder / "ready").exists():
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        pip = [folder / "bin" / "pip", "install", "--quiet", "--no-compile"]
        for packages in (LIBRARIES, ["--no-deps", *BARE]):
            if subprocess.run([*pip, *packages], check=False).returncode:
                pytest.skip("pip cannot install the libraries: no connection to PyPI?")
        (folder / "ready").touch()
    return folder / "bin" / "python"


def images_of(video, folder):
    """A folder with the frames of a video as images, whose order is the natural one: shot_9.jpg, shot_10.jpg."""
    folder.mkdir()
    with open_source(video) as source:
        for frame in source:
            cv2.imwrite(str(folder / f"shot_{frame.number}.jpg"), frame.image)
    return folder


@pytest.fixture(scope="session")
def exported(once, demo_video, succeed):
    """Gives the folder of a run and its exports: walk.csv, walk.ndjson, walk.txt ... walk.via.csv, and set."""
    video, boxes = demo_video(60)

    def fill(kind, folder):
        source = images_of(video, folder / "walk") if kind == "folder of images" else folder / "walk.mp4"
        if source.suffix:
            source.write_bytes(video.read_bytes())
        more = {"part": ["--start", 10, "--end", 50, "--stride", 3], "several objects": ["--box", "ben=20,20,40,40"]}
        box = ",".join(map(str, boxes[10 if kind == "part" else 0]))
        succeed("track", source, "--box", f"anna={box}", "--output", folder, "--lockstep", *more.get(kind, []))
        for suffix in (".txt", ".json", ".xml", ".via.csv"):
            succeed("export", folder / "walk.ndjson", folder / f"walk{suffix}")
        succeed("export", folder / "walk.ndjson", folder / "set", "--format", "yolo", "--images")

    return lambda kind: once(f"readers-{kind.replace(' ', '-')}", lambda folder: fill(kind, folder))


@pytest.fixture(params=["part", "several objects", "folder of images"])
def run(request, exported):
    return exported(request.param)


def boxes_in_csv(folder):
    """The boxes of a run: frame, number of the track, class, x, y, w, h, cut at the edges of the frame."""
    header, *lines = map(json.loads, (folder / "walk.ndjson").read_text().splitlines())
    with (folder / "walk.csv").open() as file:
        rows = [*csv.DictReader(file)]
    (width, height), numbers = header["size"], {}
    for row, line in zip(rows, lines, strict=True):  # the beginning of an object is in the NDJSON file only
        number = numbers.setdefault((line["object"], line["began"]), len(numbers) + 1)
        if row["x"]:
            x, y, w, h = (float(row[side]) for side in "xywh")
            left, top, right, bottom = max(x, 0), max(y, 0), min(x + w, width), min(y + h, height)
            yield int(row["source_frame"]), number, row["object"], left, top, right - left, bottom - top


def assert_same(read, expected):
    """Compare boxes; None stands for what a format or a library does not have."""
    read, expected = sorted(read, key=_order), sorted(expected, key=_order)
    assert [row[0] for row in read] == [row[0] for row in expected]
    for row, wanted in zip(read, expected, strict=True):
        assert [*row[1:3]] == [
            None if value is None else other for value, other in zip(row[1:3], wanted[1:3], strict=True)
        ]
        np.testing.assert_allclose(row[3:], wanted[3:], atol=0.02)


def _order(row):
    return row[0], *(round(side) for side in row[3:5])


@pytest.fixture
def read(run, libraries, tmp_path):
    """Returns what a reader prints of a file of the run."""

    def start(reader, file):
        command = [libraries, Path(__file__).with_name("readers.py"), reader, run / file]
        options = {"cwd": tmp_path, "env": {**os.environ, "YOLO_OFFLINE": "1", "YOLO_CONFIG_DIR": str(tmp_path)}}
        output = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, **options).stdout
        return [json.loads(line) for line in output.splitlines()]

    return start


@pytest.mark.parametrize("reader", READERS)
def test_a_library_reads_the_boxes_of_the_csv_file(run, read, reader):
    assert_same(read(reader, READERS[reader]), boxes_in_csv(run))

"""Loads an export with a library that reads its format, and prints the boxes that it holds, as lines of JSON.

    python tests/output/readers.py READER FILE

runs in the environment of the libraries, without catstream: see test_readers.py. A line is frame, track, class, x, y,
w, h: the number of the frame as the library counts them, from 0, and null for what the format does not have.
"""

import contextlib
import json
import re
import sys
from pathlib import Path


def number(name):
    """The number in the name of an image."""
    return int(re.search(r"(\d+)\D*$", Path(name).stem)[1])


def ultralytics_yolo(folder):
    from ultralytics.data import YOLODataset
    from ultralytics.data.utils import check_det_dataset

    data = check_det_dataset(folder / "data.yaml")
    for label in YOLODataset(data["train"], data=data, task="detect", augment=False).labels:
        height, width = label["shape"]
        for kind, (x, y, w, h) in zip(label["cls"][:, 0], label["bboxes"].tolist(), strict=True):
            box = (x - w / 2) * width, (y - h / 2) * height, w * width, h * height
            yield number(label["im_file"]), None, data["names"][int(kind)], *box


def supervision_yolo(folder):
    import supervision

    files = (str(folder / name) for name in ("images", "labels", "data.yaml"))
    dataset = supervision.DetectionDataset.from_yolo(*files)
    for path, _, boxes in dataset:
        for (left, top, right, bottom), kind in zip(boxes.xyxy.tolist(), boxes.class_id, strict=True):
            yield number(path), None, dataset.classes[kind], left, top, right - left, bottom - top


def pycocotools_coco(file):
    from pycocotools.coco import COCO

    coco = COCO(str(file))
    for entry in coco.loadAnns(coco.getAnnIds()):
        (image,), (kind,) = coco.loadImgs(entry["image_id"]), coco.loadCats(entry["category_id"])
        yield number(image["file_name"]), entry["track_id"], kind["name"], *entry["bbox"]


def datumaro_cvat(file):
    import datumaro

    dataset = datumaro.Dataset.import_from(str(file), "cvat")
    names = dataset.categories()[datumaro.AnnotationType.label]
    for item in dataset:
        for box in item.annotations:
            if not box.attributes.get("outside"):
                track = box.attributes["track_id"] + 1
                yield item.attributes["frame"], track, names[box.label].name, *box.get_bbox()


def trackeval_mot(file):
    import numpy
    from trackeval.datasets import MotChallenge2DBox

    folder = file.parent / "mot"
    for place in ("gt/walk/gt/gt.txt", "trackers/catstream/data/walk.txt"):
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_bytes(file.read_bytes())
    frames = max(int(line.split(",")[0]) for line in file.read_text().splitlines())
    options = {
        "GT_FOLDER": str(folder / "gt"), "TRACKERS_FOLDER": str(folder / "trackers"), "SEQ_INFO": {"walk": frames},
        "SKIP_SPLIT_FOL": True, "PRINT_CONFIG": False, "DO_PREPROC": False,
    }  # fmt: skip
    raw = MotChallenge2DBox(options).get_raw_seq_data("catstream", "walk")
    for frame, (ids, boxes) in enumerate(zip(raw["tracker_ids"], raw["tracker_dets"], strict=True)):
        for track, (x, y, w, h) in zip(ids.tolist(), numpy.asarray(boxes).tolist(), strict=True):
            yield frame, track, None, x - 1, y - 1, w, h


def movement_via(file):
    from movement.io import load_bboxes

    data = load_bboxes.from_via_tracks_file(file, use_frame_numbers_from_file=True)
    for frame in data.time.values.tolist():
        for individual in data.individuals.values.tolist():
            (x, y), (w, h) = (data[key].sel(time=frame, individuals=individual).values for key in ("position", "shape"))
            if x == x:
                yield frame, int(individual.removeprefix("id_")), None, x - w / 2, y - h / 2, w, h


if __name__ == "__main__":
    with contextlib.redirect_stdout(sys.stderr):
        rows = [*globals()[sys.argv[1]](Path(sys.argv[2]))]
    for frame, track, kind, *box in rows:
        print(json.dumps([int(frame), None if track is None else int(track), kind, *map(float, box)]))

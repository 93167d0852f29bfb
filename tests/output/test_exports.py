"""Formats that are made from a log."""

import csv
import json
from ast import literal_eval
from pathlib import Path
from xml.etree import ElementTree

import pytest
from pycocotools.coco import COCO

from catstream.base.box import Box
from catstream.errors import VideoError
from catstream.output.annotations import About
from catstream.output.destinations import Header, TrackedFrame
from catstream.output.exports import export, export_of
from catstream.output.track_log import Log
from catstream.wire.messages import Track

BOX = Box(10.0, 20.0, 30.5, 40.0)


def present(frame, name, box=BOX, **fields):
    state = "present" if box else "absent"
    return Track(frame, frame / 25, state, box, 0.75, 4, 17.5 if frame else None, name, **fields)


LOG = [
    TrackedFrame([present(0, "anna"), present(0, "")], 0.5),
    TrackedFrame([present(2, "", None)], 0.25),
    TrackedFrame([present(3, "ben"), present(3, "")]),
]


#: The object without a name is doubtful, then leaves and is back; anna is half outside, then another one has her name.
ANNOTATED = [
    TrackedFrame([present(0, ""), present(0, "anna", Box(-10.0, 20.0, 30.0, 40.0))]),
    TrackedFrame([present(1, "", doubtful=True), present(1, "anna", Box(-30.0, 20.0, 30.0, 40.0))]),
    TrackedFrame([present(2, "", None), present(2, "anna", began=2)]),
    TrackedFrame([present(3, ""), present(3, "anna", None, began=2)]),
]


def made(path, name=None, log=LOG, **about):
    export(log, path, export_of(path, name), About("walk", **about))
    return path


def test_mot_counts_from_one_and_has_no_line_for_an_absent_object(tmp_path):
    box = "11.00,21.00,30.50,40.00,0.7500,-1,-1,-1"
    log = [*LOG, TrackedFrame([present(4, "anna", began=4)])]  # another object of the same name
    lines = made(tmp_path / "t.txt", log=log).read_text().splitlines()
    assert lines == [f"{numbers},{box}" for numbers in ("1,1", "1,2", "4,3", "4,2", "5,4")]


def test_coco_has_tracks_and_cuts_boxes_at_the_edges(tmp_path):
    coco = COCO(made(tmp_path / "t.json", log=ANNOTATED, size=(100, 80)))
    assert [(each["id"], each["file_name"], each["width"]) for each in coco.loadImgs(coco.getImgIds())] == [
        (number + 1, f"walk_{number:06d}.jpg", 100) for number in range(4)
    ]
    assert coco.loadCats(coco.getCatIds()) == [{"id": 1, "name": "object"}, {"id": 2, "name": "anna"}]
    boxes = coco.loadAnns(coco.getAnnIds())
    assert [(each["image_id"], each["category_id"], each["track_id"], each["bbox"]) for each in boxes] == [
        (1, 1, 1, [*BOX]), (1, 2, 2, [0.0, 20.0, 20.0, 40.0]), (2, 1, 1, [*BOX]), (3, 2, 3, [*BOX]), (4, 1, 1, [*BOX]),
    ]  # fmt: skip
    assert [each["attributes"]["doubtful"] for each in boxes] == [False, False, True, False, False]
    assert (boxes[1]["area"], boxes[1]["score"], boxes[1]["iscrowd"]) == (800.0, 0.75, 0)
    lists = ("images", "tracks", "annotations")
    assert {each["video_id"] for name in lists for each in coco.dataset[name]} == {coco.dataset["videos"][0]["id"]}
    assert [each["id"] for each in coco.dataset["tracks"]] == [1, 2, 3]


def test_cvat_has_a_keyframe_for_each_box_and_ends_tracks_outside(tmp_path):
    root = ElementTree.parse(made(tmp_path / "t.xml", log=ANNOTATED, size=(100, 80))).getroot()
    assert (root.tag, root.findtext("version")) == ("annotations", "1.1")
    assert root.findtext("meta/task/mode") == "interpolation"
    assert [label.text for label in root.iterfind("meta/task/labels/label/name")] == ["object", "anna"]
    found = {
        (track.get("id"), track.get("label")): [
            (int(box.get("frame")), box.get("outside"), box.findtext("attribute[@name='doubtful']")) for box in track
        ]
        for track in root.iterfind("track")
    }
    assert found == {
        ("0", "object"): [(0, "0", "false"), (1, "0", "true"), (2, "1", "true"), (3, "0", "false")],
        ("1", "anna"): [(0, "0", "false"), (1, "1", "false")],
        ("2", "anna"): [(2, "0", "false"), (3, "1", "false")],
    }
    assert [root.findtext(f"meta/task/original_size/{side}") for side in ("width", "height")] == ["100", "80"]
    box = root.find("track/box")
    assert [float(box.get(side)) for side in ("xtl", "ytl", "xbr", "ybr")] == [10.0, 20.0, 40.5, 60.0]
    assert (box.get("keyframe"), box.get("occluded"), box.get("z_order")) == ("1", "0", "0")


def test_cvat_keyframes_have_the_checks_of_an_annotation(tmp_path):
    checks = ("keyframe", "hidden", "checked", "unchecked")
    log = [TrackedFrame([present(frame, "anna", checked=check)]) for frame, check in enumerate(checks)]
    root = ElementTree.parse(made(tmp_path / "t.xml", log=log, size=(100, 80))).getroot()
    boxes = [(box.get("keyframe"), box.findtext("attribute[@name='checked']")) for box in root.iter("box")]
    assert boxes == [("1", check) for check in checks], "CVAT drops boxes that are no keyframes"
    (values,) = (each.findtext("values") for each in root.iter("attribute") if each.findtext("name") == "checked")
    assert {*values.split()} == {*checks}


def test_yolo_has_a_file_of_relative_boxes_for_each_frame(tmp_path):
    folder = made(tmp_path / "set", "yolo", [*ANNOTATED[:2], TrackedFrame([present(2, "", None)])], size=(100, 80))
    object_line, half = "0 0.252500 0.500000 0.305000 0.500000\n", "1 0.100000 0.500000 0.200000 0.500000\n"
    assert {file.name: file.read_text() for file in (folder / "labels").iterdir()} == {
        "walk_000000.txt": object_line + half,
        "walk_000001.txt": object_line,
        "walk_000002.txt": "",
    }
    assert (folder / "data.yaml").read_text().endswith('names:\n  0: "object"\n  1: "anna"\n')


def test_via_has_a_row_for_each_box_as_movement_reads_it(tmp_path):
    with made(tmp_path / "t.via.csv", log=ANNOTATED).open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header == [
        *("filename", "file_size", "file_attributes", "region_count"),
        *("region_id", "region_shape_attributes", "region_attributes"),
    ]
    assert rows[1][:2] + rows[1][3:5] == ["walk_000000.jpg", "-1", "2", "1"]
    file, shape, region = (literal_eval(rows[2][column]) for column in (2, 5, 6))  # movement reads Python's literals
    assert (file, shape) == ({"frame": 1}, {"name": "rect", "x": 10.0, "y": 20.0, "width": 30.5, "height": 40.0})
    assert region == {"track": 1, "confidence": 0.75, "class": "object", "doubtful": 1}
    assert [literal_eval(row[6])["track"] for row in rows] == [1, 2, 1, 2, 3, 1]


@pytest.mark.parametrize(("name", "kind"), [("t.json", None), ("t.xml", None), ("folder", "yolo")])
def test_format_with_the_frame_size_requires_the_source(tmp_path, name, kind):
    with pytest.raises(VideoError, match="pass the video or folder"):
        made(tmp_path / name, kind)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("disk", [1 << 16], indirect=True)
@pytest.mark.parametrize("suffix", [".txt", ".sqlite", ".json", ".xml", ".via.csv"])
def test_full_disk_leaves_the_earlier_file_as_it_is(disk, suffix):
    (disk / f"t{suffix}").write_text("earlier")
    (disk / "ballast").write_bytes(bytes((1 << 16) - 4096))
    with pytest.raises(VideoError, match="cannot write"):
        made(disk / f"t{suffix}", log=[TrackedFrame([present(frame, "")]) for frame in range(999)], size=(100, 80))
    assert {file.name for file in disk.iterdir()} == {"ballast", f"t{suffix}"}
    assert (disk / f"t{suffix}").read_text() == "earlier"


def test_unknown_suffix_requires_the_option_format(tmp_path):
    for name in ("t.xls", "folder"):
        with pytest.raises(VideoError, match="pass --format, one of mot, csv"):
            export_of(tmp_path / name, None)


def test_every_format_has_the_frame_numbers_of_the_source(tmp_path):
    log = [TrackedFrame([present(frame, "", source_frame=20 + 5 * frame)]) for frame in range(3)]
    about = {"log": log, "size": (100, 80), "header": Header(start=20, stride=5), "frames": 40}
    files = {suffix: made(tmp_path / f"t{suffix}", **about) for suffix in (".txt", ".json", ".xml", ".via.csv")}
    mot = [int(line.split(",")[0]) - 1 for line in files[".txt"].read_text().splitlines()]
    coco = json.loads(files[".json"].read_text())["images"]
    boxes = [(int(box.get("frame")), box.get("outside")) for box in ElementTree.parse(files[".xml"]).iter("box")]
    with files[".via.csv"].open(newline="") as file:
        via = [literal_eval(row["file_attributes"])["frame"] for row in csv.DictReader(file)]
    assert mot == [image["frame_index"] for image in coco] == via == [20, 25, 30]
    assert boxes == [(20, "0"), (25, "0"), (30, "0"), (35, "1")]
    names = [image["file_name"] for image in coco]
    labels = made(tmp_path / "set", "yolo", **about) / "labels"
    assert names == ["walk_000020.jpg", "walk_000025.jpg", "walk_000030.jpg"]
    assert sorted(file.stem for file in labels.iterdir()) == [Path(name).stem for name in names]


@pytest.mark.parametrize(
    ("frames", "keys"), [(9, [(0, "0"), (1, "1"), (3, "0"), (4, "1")]), (4, [(0, "0"), (1, "1"), (3, "0")])]
)
def test_cvat_ends_a_track_unless_the_video_ends_there(tmp_path, frames, keys):
    log = [TrackedFrame([present(0, "")]), TrackedFrame([present(3, "")])]
    root = ElementTree.parse(made(tmp_path / "t.xml", log=log, size=(100, 80), frames=frames))
    assert [(int(box.get("frame")), box.get("outside")) for box in root.iter("box")] == keys


@pytest.mark.parametrize(("classes", "names"), [((), ["anna", "ben"]), (("ben", "anna"), ["ben", "anna"])])
def test_classes_are_numbered_even_if_never_present(tmp_path, classes, names):
    log = [TrackedFrame([present(0, "anna", None), present(0, "ben", None)])]
    about = {"log": log, "size": (100, 80), "classes": classes}
    coco = json.loads(made(tmp_path / "t.json", **about).read_text())["categories"]
    labels = ElementTree.parse(made(tmp_path / "t.xml", **about)).iterfind("meta/task/labels/label/name")
    yaml = (made(tmp_path / "set", "yolo", **about) / "data.yaml").read_text()
    assert yaml.endswith('names:\n  0: "{}"\n  1: "{}"\n'.format(*names))
    assert [(entry["id"], entry["name"]) for entry in coco] == [*enumerate(names, 1)]
    assert [label.text for label in labels] == names


def test_missing_class_is_an_error_before_the_first_file(tmp_path):
    folder = made(tmp_path / "set", "yolo", LOG, size=(100, 80))
    before = {file: file.read_bytes() for file in folder.rglob("*.*")}
    with pytest.raises(VideoError, match="--classes lacks 'object'"):
        made(folder, "yolo", LOG, size=(100, 80), classes=("anna", "ben"))
    assert {file: file.read_bytes() for file in folder.rglob("*.*")} == before


def test_labels_have_the_names_of_the_images(tmp_path):
    images = [tmp_path / f"shot_{number}.png" for number in (9, 10, 11)]
    for number, image in enumerate(images):
        image.write_bytes(b"%d" % number)
    log = [TrackedFrame([present(0, "", source_frame=1)])]
    folder = made(tmp_path / "set", "yolo", log, size=(100, 80), images=images, source=str(tmp_path))
    assert [file.name for file in (folder / "labels").iterdir()] == ["shot_10.txt"]
    assert [(file.name, file.read_bytes()) for file in (folder / "images").iterdir()] == [("shot_10.png", b"1")]


def test_csv_is_made_from_other_logs(tmp_path):
    log = [TrackedFrame([present(frame, "anna"), present(frame, "", None)], 0.5) for frame in range(2)]
    read = Log(made(tmp_path / "t.csv", log=log))
    assert [track.box for frame in read for track in frame.tracks] == [BOX, None] * 2

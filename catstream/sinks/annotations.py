"""Formats of annotation tools and data sets, made from a log: COCO, CVAT for video, YOLO and VIA tracks.

The image of a frame is called NAME_000000.jpg, with the name of the log and the number of the frame. A doubtful box is
marked, but in YOLO, which has no place for it.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from catstream.base.box import Box
from catstream.messages.kinds import Track
from catstream.sinks.destinations import About, TrackedFrame

Fields = dict[str, Any]

_VIA_COLUMNS = (
    *("filename", "file_size", "file_attributes", "region_count"),
    *("region_id", "region_shape_attributes", "region_attributes"),
)

_CVAT_HEAD = """<?xml version="1.0" encoding="utf-8"?>
<annotations><version>1.1</version>
<meta><task><name>{name}</name><size>{frames}</size><mode>interpolation</mode><labels>
{labels}
</labels><original_size><width>{width}</width><height>{height}</height></original_size></task></meta>
"""
_CVAT_LABEL = (
    "<label><name>{}</name><attributes><attribute><name>doubtful</name><mutable>True</mutable><input_type>checkbox"
    "</input_type><default_value>false</default_value><values>false</values></attribute></attributes></label>"
)
_CVAT_BOX = (
    '<box frame="{}" outside="{:d}" occluded="0" keyframe="1" xtl="{:.2f}" ytl="{:.2f}" xbr="{:.2f}" ybr="{:.2f}" '
    'z_order="0"><attribute name="doubtful">{}</attribute></box>\n'
)


class _Place(NamedTuple):
    """A box of an object, whose number counts from 1; another object that was given the same name has another one."""

    number: int
    label: str
    track: Track
    box: Box


def write_coco(frames: Iterable[TrackedFrame], path: Path, about: About) -> None:
    """Write the objects of COCO, with the fields that TAO adds for videos and tracks; ids count from 1."""
    classes: dict[str, int] = {}
    images: list[Fields] = []
    tracks: dict[int, Fields] = {}
    boxes: list[Fields] = []
    size = _size(about)
    for frame, places in _places(frames, about):
        image = {"id": frame + 1, "file_name": f"{_stem(about, frame)}.jpg", **size}
        images.append(image | {"video_id": 1, "frame_index": frame})
        for number, label, track, box in places:
            of = {"category_id": classes.setdefault(label, len(classes) + 1), "video_id": 1}
            tracks[number] = {"id": number, "name": track.object, **of}
            ids = {"id": len(boxes) + 1, "image_id": frame + 1, "track_id": number, **of}
            shape = {"bbox": [round(side, 2) for side in box], "area": round(box.area, 2), "iscrowd": 0}
            boxes.append({**ids, **shape, "score": track.score, "attributes": {"doubtful": track.doubtful}})
    data = {
        "info": {"description": f"tracks of {about.name}"},
        "videos": [{"id": 1, "name": about.name, **size}],
        "images": images,
        "categories": [{"id": number, "name": label} for label, number in classes.items()],
        "tracks": [*tracks.values()],
        "annotations": boxes,
    }
    path.write_text(json.dumps(data), encoding="utf-8")


def write_cvat(frames: Iterable[TrackedFrame], path: Path, about: About) -> None:
    """Write `CVAT for video 1.1`: a key frame for each box, and one that is outside where the object disappears."""
    objects: dict[int, list[_Place]] = {}
    end = 0
    for frame, places in _places(frames, about):
        end = frame + 1
        for place in places:
            objects.setdefault(place.number, []).append(place)
    labels = dict.fromkeys(escape(places[0].label) for places in objects.values())
    with path.open("w", encoding="utf-8") as file:
        kinds = "\n".join(map(_CVAT_LABEL.format, labels))
        file.write(_CVAT_HEAD.format(name=escape(about.name), frames=end, labels=kinds, **_size(about)))
        for number, places in objects.items():
            file.write(f'<track id="{number - 1}" label="{escape(places[0].label)}" source="auto">\n')
            following = [*(place.track.frame for place in places[1:]), end]
            for place, after in zip(places, following, strict=True):
                frame, (x, y, w, h) = place.track.frame, place.box
                rest = x, y, x + w, y + h, str(place.track.doubtful).lower()
                file.write(_CVAT_BOX.format(frame, False, *rest))
                if frame + 1 < after:
                    file.write(_CVAT_BOX.format(frame + 1, True, *rest))
            file.write("</track>\n")
        file.write("</annotations>\n")


def write_yolo(frames: Iterable[TrackedFrame], folder: Path, about: About) -> None:
    """Write the labels of a YOLO data set, `class x y w h` of the centre in parts of the frame, and its data.yaml.

    There is a file for each frame, which is empty if there is no box.
    """
    classes: dict[str, int] = {}
    width, height = _size(about).values()
    (folder / "labels").mkdir(parents=True, exist_ok=True)
    for frame, places in _places(frames, about):
        lines = []
        for _, label, _, box in places:
            x, y = box.centre
            sides = x / width, y / height, box.w / width, box.h / height
            lines.append(f"{classes.setdefault(label, len(classes))} {' '.join(f'{side:.6f}' for side in sides)}\n")
        (folder / "labels" / f"{_stem(about, frame)}.txt").write_text("".join(lines))
    names = "".join(f"  {number}: {json.dumps(label)}\n" for label, number in classes.items())
    (folder / "data.yaml").write_text(f"path: .\ntrain: images\nval: images\nnames:\n{names}", encoding="utf-8")


def write_via(frames: Iterable[TrackedFrame], path: Path, about: About) -> None:
    """Write the tracks of the VGG Image Annotator, one row for each box, as movement and napari read them."""
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(_VIA_COLUMNS)
        for frame, places in _places(frames, about):
            for index, (number, label, track, (x, y, w, h)) in enumerate(places):
                shape = {"name": "rect", "x": x, "y": y, "width": w, "height": h}
                attributes = {
                    "track": number,
                    "confidence": track.score,
                    "class": label,
                    "doubtful": int(track.doubtful),
                }
                dicts = [json.dumps(each) for each in ({"frame": frame}, shape, attributes)]
                rows.writerow([f"{_stem(about, frame)}.jpg", -1, dicts[0], len(places), index, *dicts[1:]])


def _places(frames: Iterable[TrackedFrame], about: About) -> Iterator[tuple[int, list[_Place]]]:
    """Yield the number of each frame, and its boxes; if the size of the frames is known, their parts in the frame."""
    numbers: dict[tuple[str, int], int] = {}
    for frame in frames:
        places = []
        for track in frame.tracks:
            number = numbers.setdefault((track.object, track.began), len(numbers) + 1)
            if (box := _cut(track.box, about.size)) is not None:
                places.append(_Place(number, about.label or track.object or "object", track, box))
        yield frame.number, places


def _cut(box: Box | None, size: tuple[int, int] | None) -> Box | None:
    """Return the part of a box that is in the frame; None if there is none."""
    if box is None or size is None:
        return box
    x, y = max(box.x, 0.0), max(box.y, 0.0)
    w, h = min(box.x + box.w, size[0]) - x, min(box.y + box.h, size[1]) - y
    return Box(x, y, w, h) if w > 0 and h > 0 else None


def _size(about: About) -> dict[str, int]:
    width, height = about.size or (0, 0)  # the formats that need it are not made without it
    return {"width": width, "height": height}


def _stem(about: About, frame: int) -> str:
    return f"{about.name}_{frame:06d}"

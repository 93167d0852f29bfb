"""Exports to annotation tools and data sets: COCO, CVAT for video, YOLO and VIA tracks.

Frames are numbered as in the source. The image of a frame is NAME_000000.jpg, with the name of the log and the frame
number. An image of a folder keeps its name, prefixed with NAME_ in a data set of several logs. Doubtful boxes are
marked, except in YOLO, which has no field for it; CVAT also has the field `checked` of an annotation.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from catstream.base.box import Box
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.output.destinations import Header, TrackedFrame
from catstream.video.frames import jpeg
from catstream.video.source import open_source
from catstream.wire.messages import Track

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
    "</input_type><default_value>false</default_value><values>false</values></attribute>{}</attributes></label>"
)
_CVAT_CHECKED = (
    "<attribute><name>checked</name><mutable>True</mutable><input_type>select</input_type><default_value>unchecked"
    "</default_value><values>unchecked\nchecked\nhidden\nkeyframe</values></attribute>"
)
_CVAT_BOX = (
    '<box frame="{}" outside="{:d}" occluded="0" keyframe="1" xtl="{:.2f}" ytl="{:.2f}" xbr="{:.2f}" ybr="{:.2f}" '
    'z_order="0"><attribute name="doubtful">{}</attribute>{}</box>\n'
)


@dataclass(frozen=True, slots=True)
class About:
    """The parameters of an export.

    name     name of the log, for the images
    header   header of the log; by default an empty one
    size     width and height of a frame in pixels; None if unknown
    frames   number of frames of the source; None if unknown
    label    class of all objects; if empty, the class of an object is its name
    classes  names of the classes in the order of their numbers; empty for the order of the log
    images   files of the images of the source; empty for a video
    prefix   prefix for the names of these images, because several logs may use the same names
    source   path of the source whose images are written; empty to write no images
    is_first whether this is the first log of a data set, for which existing labels are removed
    """

    name: str
    header: Header = field(default_factory=Header)
    size: tuple[int, int] | None = None
    frames: int | None = None
    label: str = ""
    classes: Sequence[str] = ()
    images: Sequence[Path] = ()
    prefix: str = ""
    source: str = ""
    is_first: bool = True


class _Item(NamedTuple):
    """A box of an object. Objects are numbered from 1; a new object that reuses a name has a new number."""

    number: int
    label: str
    track: Track
    box: Box


def write_coco(frames: Iterable[TrackedFrame], path: Path, about: About) -> None:
    """Write COCO, with TAO's fields for videos and tracks; ids count from 1."""
    classes = _numbers(frames, about, first=1)
    images: list[dict[str, Any]] = []
    tracks: dict[int, dict[str, Any]] = {}
    boxes: list[dict[str, Any]] = []
    size = _size(about)
    for frame, items in _items(frames, about):
        image = {"id": frame + 1, "file_name": _image(about, frame), **size}
        images.append(image | {"video_id": 1, "frame_index": frame})
        for number, label, track, box in items:
            of = {"category_id": classes[label], "video_id": 1}
            tracks[number] = {"id": number, "name": track.object, **of}
            ids = {"id": len(boxes) + 1, "image_id": image["id"], "track_id": number, **of}
            shape = {"bbox": [round(side, 2) for side in box], "area": round(box.area, 2), "iscrowd": 0}
            boxes.append({**ids, **shape, "score": track.score, "attributes": {"doubtful": track.doubtful}})
    data = {
        "info": {"description": f"tracks of {about.name}"},
        "videos": [{"id": 1, "name": about.name, **size}],
        "images": images,
        "categories": [{"id": number, "name": name} for name, number in classes.items()],
        "tracks": [*tracks.values()],
        "annotations": boxes,
    }
    path.write_text(json.dumps(data), encoding="utf-8")


def write_cvat(frames: Iterable[TrackedFrame], path: Path, about: About) -> str:
    """Write `CVAT for video 1.1`: a keyframe for each box, and an outside keyframe where the object disappears.

    CVAT drops boxes that are not keyframes, and interpolates. The attribute `checked` therefore marks the boxes that a
    person drew in an annotation.

    CVAT rejects frames beyond the end of its video, so a track up to the last frame has no outside keyframe. If
    `about.frames` is None, the last frame of the log is assumed to be the last one; returns a note about it.
    """
    # Step 1: the boxes of each object, and the number of frames.
    objects: dict[int, list[_Item]] = {}
    end, step = 0, about.header.stride
    for frame, items in _items(frames, about):
        end = frame + 1
        for item in items:
            objects.setdefault(item.number, []).append(item)
    note = "" if about.frames else "the video was not read: its last frame is assumed to be the last tracked one"
    end = about.frames or end
    # Step 2: write a track for each object, with an outside keyframe before each gap.
    checked = any(item.track.checked for items in objects.values() for item in items)
    kinds = (_CVAT_LABEL.format(escape(name), _CVAT_CHECKED if checked else "") for name in _numbers(frames, about))
    with path.open("w", encoding="utf-8") as file:
        file.write(_CVAT_HEAD.format(name=escape(about.name), frames=end, labels="\n".join(kinds), **_size(about)))
        for number, items in objects.items():
            file.write(f'<track id="{number - 1}" label="{escape(items[0].label)}" source="auto">\n')
            following = [*(item.track.source_frame for item in items[1:]), end]
            for item, after in zip(items, following, strict=True):
                frame, (x, y, w, h) = item.track.source_frame, item.box
                check = f'<attribute name="checked">{item.track.checked}</attribute>' if checked else ""
                rest = x, y, x + w, y + h, str(item.track.doubtful).lower(), check
                file.write(_CVAT_BOX.format(frame, False, *rest))
                if frame + step < after:
                    file.write(_CVAT_BOX.format(frame + step, True, *rest))
            file.write("</track>\n")
        file.write("</annotations>\n")
    return note


def write_yolo(frames: Iterable[TrackedFrame], folder: Path, about: About) -> None:
    """Write the labels of a YOLO data set, `class x y w h` with the centre relative to the frame, and its data.yaml.

    Each frame has a file, which is empty without boxes.
    """
    classes, labels = _numbers(frames, about), folder / "labels"
    labels.mkdir(parents=True, exist_ok=True)
    (folder / "labels.cache").unlink(missing_ok=True)  # Ultralytics would use it for new labels of the same total size
    for file in labels.glob("*.txt") if about.is_first else ():
        file.unlink()
    names = "".join(f"  {number}: {json.dumps(name, ensure_ascii=False)}\n" for name, number in classes.items())
    (folder / "data.yaml").write_text(f"train: images\nval: images\nnames:\n{names}", encoding="utf-8")
    width, height = _size(about).values()
    for frame, items in _items(frames, about):
        lines = []
        for _, label, _, box in items:
            x, y = box.centre
            sides = x / width, y / height, box.w / width, box.h / height
            lines.append(f"{classes[label]} {' '.join(f'{side:.6f}' for side in sides)}\n")
        (labels / f"{Path(_image(about, frame)).stem}.txt").write_text("".join(lines))
    if about.source:
        _write_images(frames, folder / "images", about)


def _write_images(frames: Iterable[TrackedFrame], folder: Path, about: About) -> None:
    """Write the images of the tracked frames: copies of the files of a folder, or JPEG. Existing files are kept."""
    numbers = {frame.tracks[0].source_frame for frame in frames}
    folder.mkdir(exist_ok=True)
    missing = {number for number in numbers if not (folder / _image(about, number)).exists()}
    for number in missing if about.images else ():
        shutil.copyfile(about.images[number], folder / _image(about, number))
    if missing and not about.images:
        with open_source(about.source, part=slice(min(missing), max(missing) + 1)) as source:
            for number, frame in enumerate(source, min(missing)):
                if number in missing:
                    (folder / _image(about, number)).write_bytes(jpeg(frame.image, quality=95))


def write_via(frames: Iterable[TrackedFrame], path: Path, about: About) -> None:
    """Write tracks for the VGG Image Annotator, movement and napari: one row for each box."""
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(_VIA_COLUMNS)
        for frame, items in _items(frames, about):
            for index, (number, label, track, (x, y, w, h)) in enumerate(items):
                shape = {"name": "rect", "x": x, "y": y, "width": w, "height": h}
                attributes = {
                    "track": number,
                    "confidence": track.score,
                    "class": label,
                    "doubtful": int(track.doubtful),
                }
                cells = [json.dumps(fields, ensure_ascii=False) for fields in ({"frame": frame}, shape, attributes)]
                rows.writerow([_image(about, frame), -1, cells[0], len(items), index, *cells[1:]])


def _items(frames: Iterable[TrackedFrame], about: About) -> Iterator[tuple[int, list[_Item]]]:
    """Yield each frame's number in the source and its boxes, clipped to the frame if its size is known."""
    numbers: dict[tuple[str, int], int] = {}
    for frame in frames:
        items = []
        for track in frame.tracks:
            number = numbers.setdefault((track.object, track.began), len(numbers) + 1)
            if (box := _clip(track.box, about.size)) is not None:
                items.append(_Item(number, _label(track, about.label), track, box))
        yield frame.tracks[0].source_frame, items


def _numbers(frames: Iterable[TrackedFrame], about: About, *, first: int = 0) -> dict[str, int]:
    """Return the number of each class, in the order of `about.classes` or, without them, of the log.

    Objects that are never present have a class as well. Raises VideoError if `about.classes` lacks a class.
    """
    classes = classes_of(frames, about.label)
    if about.classes and (missing := [name for name in classes if name not in about.classes]):
        raise VideoError(f"--classes lacks {missing[0]!r}: add it, or give all objects one class with --label")
    return {name: number for number, name in enumerate(about.classes or classes, first)}


def classes_of(frames: Iterable[TrackedFrame], label: str) -> list[str]:
    """Return the classes of a log, in the order of their first tracks."""
    return [*dict.fromkeys(_label(track, label) for frame in frames for track in frame.tracks)]


def _label(track: Track, label: str) -> str:
    return label or track.object or "object"


def _clip(box: Box | None, size: tuple[int, int] | None) -> Box | None:
    """Clip a box to the frame; None if it is outside."""
    if box is None or size is None:
        return box
    x, y = max(box.x, 0.0), max(box.y, 0.0)
    w, h = min(box.x + box.w, size[0]) - x, min(box.y + box.h, size[1]) - y
    return Box(x, y, w, h) if w > 0 and h > 0 else None


def _size(about: About) -> dict[str, int]:
    width, height = about.size or (0, 0)  # `export` requires the size for formats that use it
    return {"width": width, "height": height}


def _image(about: About, frame: int) -> str:
    """The file name of the image of a frame."""
    if not about.images:
        return f"{about.name}_{frame:06d}.jpg"
    if frame >= len(about.images):
        count = counted(len(about.images), "image")
        raise VideoError(f"the log has frame {frame}, but its folder has {count}: pass another one (--source)")
    return about.prefix + about.images[frame].name

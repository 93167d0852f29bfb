"""Formats of annotation tools and data sets, made from a log: COCO, CVAT for video, YOLO and VIA tracks.

Frames have their numbers in the source. The image of a frame is NAME_000000.jpg, with the name of the log and the
number of the frame; if a folder of images was tracked, it has the name that it has there. A doubtful box is marked,
except in YOLO, which has no place for it; CVAT also has `checked` of an annotation.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from catstream.base.box import Box
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.destinations import About, TrackedFrame
from catstream.video.frames import jpeg
from catstream.video.source import open_source

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
    "</input_type><default_value>false</default_value><values>false</values></attribute>{}</attributes></label>"
)
_CVAT_CHECKED = (
    "<attribute><name>checked</name><mutable>True</mutable><input_type>select</input_type><default_value>unchecked"
    "</default_value><values>unchecked\nchecked\nkeyframe</values></attribute>"
)
_CVAT_BOX = (
    '<box frame="{}" outside="{:d}" occluded="0" keyframe="1" xtl="{:.2f}" ytl="{:.2f}" xbr="{:.2f}" ybr="{:.2f}" '
    'z_order="0"><attribute name="doubtful">{}</attribute>{}</box>\n'
)

#: The classes in a data.yaml, as a list or by number, in brackets or one on each line.
_YAML_NAMES = re.compile(r"^names:[ \t]*(?:[\[{]([^\]}]*)[\]}]|((?:\n[ \t]*(?:-|\d+ *:|#)[^\n]*)+))", re.MULTILINE)
_YAML_NAME = re.compile(r"""\s*(?:(\d+)\s*:|-)?\s*(?:("(?:[^"\\]|\\.)*")|'([^']*)'|([^#"']*?))\s*(?:#.*)?""")


class _Place(NamedTuple):
    """A box of an object, whose number counts from 1; another object that was given the same name has another one."""

    number: int
    label: str
    track: Track
    box: Box


def write_coco(frames: Iterable[TrackedFrame], path: Path, about: About) -> None:
    """Write the objects of COCO, with the fields that TAO adds for videos and tracks; ids count from 1.

    If `about.append`, add a video to an existing file. Raises VideoError if it contains one of the images, or if a
    class has another number there.
    """
    try:
        data: Fields = json.loads(path.read_bytes()) if about.append and path.exists() else {}
        existing = {category["name"]: category["id"] for category in data.get("categories", [])}
        names = {image["file_name"] for image in data.get("images", [])}
        last_video, last_image, last_track, last_box = (
            max((entry["id"] for entry in data.get(key, [])), default=0)
            for key in ("videos", "images", "tracks", "annotations")
        )
    except (AttributeError, KeyError, TypeError, ValueError):
        raise VideoError("the existing file is not in COCO format: pass --overwrite, or use another name") from None
    classes = _numbers(frames, about, existing, first=1)
    images: list[Fields] = []
    tracks: dict[int, Fields] = {}
    boxes: list[Fields] = []
    size, video = _size(about), last_video + 1
    for frame, places in _places(frames, about):
        image = {"id": last_image + frame + 1, "file_name": _image(about, frame), **size}
        images.append(image | {"video_id": video, "frame_index": frame})
        for number, label, track, box in places:
            number += last_track
            of = {"category_id": classes[label], "video_id": video}
            tracks[number] = {"id": number, "name": track.object, **of}
            ids = {"id": last_box + len(boxes) + 1, "image_id": image["id"], "track_id": number, **of}
            shape = {"bbox": [round(side, 2) for side in box], "area": round(box.area, 2), "iscrowd": 0}
            boxes.append({**ids, **shape, "score": track.score, "attributes": {"doubtful": track.doubtful}})
    if common := names & {image["file_name"] for image in images}:
        raise VideoError(f"the file contains the image {min(common)} already: replace the file with --overwrite")
    data.setdefault("info", {"description": f"tracks of {about.name}"})
    for key, entries in {
        "videos": [{"id": video, "name": about.name, **size}],
        "images": images,
        "categories": [{"id": classes[name], "name": name} for name in classes if name not in existing],
        "tracks": [*tracks.values()],
        "annotations": boxes,
    }.items():
        data[key] = data.get(key, []) + entries
    path.write_text(json.dumps(data), encoding="utf-8")


def write_cvat(frames: Iterable[TrackedFrame], path: Path, about: About) -> str:
    """Write `CVAT for video 1.1`: a keyframe for each box, and one that is outside where the object disappears.

    CVAT drops the boxes of a file that are no keyframes, and interpolates. So those that a person drew in an
    annotation are marked by the attribute `checked`.

    CVAT refuses a file with a frame that its video does not have, so a track that reaches the last frame of the source
    has no such end. If `about.frames` is None, this is the last frame of the log; returns a line that says so.
    """
    objects: dict[int, list[_Place]] = {}
    end, step = 0, about.head.stride
    for frame, places in _places(frames, about):
        end = frame + 1
        for place in places:
            objects.setdefault(place.number, []).append(place)
    note = "" if about.frames else "the video was not read: its last frame is assumed to be the last tracked one"
    end = about.frames or end
    checked = any(place.track.checked for places in objects.values() for place in places)
    labels = (_CVAT_LABEL.format(escape(name), _CVAT_CHECKED if checked else "") for name in _numbers(frames, about))
    with path.open("w", encoding="utf-8") as file:
        kinds = "\n".join(labels)
        file.write(_CVAT_HEAD.format(name=escape(about.name), frames=end, labels=kinds, **_size(about)))
        for number, places in objects.items():
            file.write(f'<track id="{number - 1}" label="{escape(places[0].label)}" source="auto">\n')
            following = [*(place.track.source_frame for place in places[1:]), end]
            for place, after in zip(places, following, strict=True):
                frame, (x, y, w, h) = place.track.source_frame, place.box
                check = f'<attribute name="checked">{place.track.checked}</attribute>' if checked else ""
                rest = x, y, x + w, y + h, str(place.track.doubtful).lower(), check
                file.write(_CVAT_BOX.format(frame, False, *rest))
                if frame + step < after:
                    file.write(_CVAT_BOX.format(frame + step, True, *rest))
            file.write("</track>\n")
        file.write("</annotations>\n")
    return note


def write_yolo(frames: Iterable[TrackedFrame], folder: Path, about: About) -> str:
    """Write the labels of a YOLO data set, `class x y w h` of the centre in parts of the frame, and its data.yaml.

    There is a file for each frame, which is empty if there is no box. If `about.append`, the classes of the data set
    keep their numbers, and files that exist are not replaced: returns how many; otherwise all labels are. Raises
    VideoError if a class has another number in the data set.
    """
    labels, yaml = folder / "labels", folder / "data.yaml"
    existing = _yaml_names(yaml) if about.append and (yaml.exists() or labels.exists()) else {}
    classes = _numbers(frames, about, existing)
    labels.mkdir(parents=True, exist_ok=True)
    (folder / "labels.cache").unlink(missing_ok=True)  # Ultralytics takes it for that of other labels of the same size
    if not about.append:
        for file in labels.glob("*.txt"):
            file.unlink()
    text = yaml.read_text(encoding="utf-8") if existing else "train: images\nval: images\nnames:\n  - none\n"
    yaml.write_text(_with_names(text, {number: name for name, number in classes.items()}), encoding="utf-8")
    width, height = _size(about).values()
    added, skipped = 0, []
    for frame, places in _places(frames, about):
        lines = []
        for _, label, _, box in places:
            x, y = box.centre
            sides = x / width, y / height, box.w / width, box.h / height
            lines.append(f"{classes[label]} {' '.join(f'{side:.6f}' for side in sides)}\n")
        file = labels / f"{Path(_image(about, frame)).stem}.txt"
        if file.exists():
            skipped.append(file.name)
        else:
            file.write_text("".join(lines))
            added += 1
    if about.source:
        _write_images(frames, folder / "images", about)
    if not skipped:
        return ""
    return f"added {counted(added, 'label file')}, did not replace {len(skipped)} that exist ({skipped[0]} ...)"


def _write_images(frames: Iterable[TrackedFrame], folder: Path, about: About) -> None:
    """Write the images of the tracked frames: copies of those of a folder, otherwise as JPEG; none is replaced."""
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


def _yaml_names(file: Path) -> dict[str, int]:
    """Return the classes of a YOLO data set; raise VideoError if they cannot be read."""
    names: dict[str, int] = {}
    match = _YAML_NAMES.search(file.read_text(encoding="utf-8")) if file.exists() else None
    entries = (match[1].split(",") if match[2] is None else match[2].splitlines()) if match else []
    for entry in (entry for entry in entries if entry.strip() and not entry.lstrip().startswith("#")):
        parsed = _YAML_NAME.fullmatch(entry)
        if parsed is None:
            names.clear()
            break
        number, double, single, plain = parsed.groups()
        name = json.loads(double) if double else plain if single is None else single
        names[name] = len(names) if number is None else int(number)
    if not names:
        raise VideoError(f"cannot read the classes of the data set in {file}: write them as lines 0: NAME below names:")
    return names


def _with_names(text: str, names: Mapping[int, str]) -> str:
    """Return a data.yaml with these classes by number; Ultralytics needs a name for each number below the highest."""
    numbers = range(max(names) + 1)
    lines = "".join(f"\n  {n}: {json.dumps(names.get(n, f'class_{n}'), ensure_ascii=False)}" for n in numbers)
    text = _YAML_NAMES.sub(lambda _: f"names:{lines}", text, count=1)
    return re.sub(r"(?m)^nc:.*$", f"nc: {len(numbers)}", text)


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
                cells = [json.dumps(fields, ensure_ascii=False) for fields in ({"frame": frame}, shape, attributes)]
                rows.writerow([_image(about, frame), -1, cells[0], len(places), index, *cells[1:]])


def _places(frames: Iterable[TrackedFrame], about: About) -> Iterator[tuple[int, list[_Place]]]:
    """Yield each frame's number in the source and its boxes, cut at the edges of the frame if its size is known."""
    numbers: dict[tuple[str, int], int] = {}
    for frame in frames:
        places = []
        for track in frame.tracks:
            number = numbers.setdefault((track.object, track.began), len(numbers) + 1)
            if (box := _cut(track.box, about.size)) is not None:
                places.append(_Place(number, _label(track, about), track, box))
        yield frame.tracks[0].source_frame, places


def _numbers(
    frames: Iterable[TrackedFrame], about: About, existing: Mapping[str, int] | None = None, *, first: int = 0
) -> dict[str, int]:
    """Return the number of each class: `existing` ones, those of `about.classes`, or the next number for each other.

    An object that is never present has a class, too. Raises VideoError if two classes have the same number, or one has
    two, or if `about.classes` lacks one.
    """
    numbers = dict(existing or {})
    for index, (label, number) in enumerate(about.classes.items(), first):
        number = index if number is None else number
        if numbers.setdefault(label, number) != number:
            raise VideoError(f"--classes numbers {label} {number}, but in the data set it is class {numbers[label]}")
    for label in dict.fromkeys(_label(track, about) for frame in frames for track in frame.tracks):
        if label not in numbers and about.classes:
            raise VideoError(f"--classes lacks {label}: add it, or give all objects one class with --label")
        numbers.setdefault(label, max(numbers.values(), default=first - 1) + 1)
    owners: dict[int, str] = {}
    for label, number in numbers.items():
        if owners.setdefault(number, label) != label:
            raise VideoError(f"two classes have the number {number}, {owners[number]} and {label}: change --classes")
    return dict(sorted(numbers.items(), key=lambda item: item[1]))


def _label(track: Track, about: About) -> str:
    return about.label or track.object or "object"


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


def _image(about: About, frame: int) -> str:
    """The file name of the image of a frame."""
    if not about.images:
        return f"{about.name}_{frame:06d}.jpg"
    if frame >= len(about.images):
        count = counted(len(about.images), "image")
        raise VideoError(f"the log has frame {frame}, but its folder has {count}: pass --size SOURCE with another one")
    return about.images[frame].name

"""The table of export formats, into which a log is converted: `catstream export LOG DEST`.

A new format is a row here, a function, and a line in docs/how-to/sinks.md.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from catstream.base.files import remove_parts, writing
from catstream.errors import VideoError
from catstream.output.annotations import About, write_coco, write_cvat, write_via, write_yolo
from catstream.output.database import write_database
from catstream.output.destinations import Origin, TrackedFrame, check_result
from catstream.output.track_log import CsvSink


def write_mot(frames: Iterable[TrackedFrame], path: Path, _: About) -> None:
    """Write boxes in the format of MOTChallenge: `frame,id,x,y,w,h,conf,-1,-1,-1`.

    Frames of the source, ids and pixels count from 1. Ids follow the order of appearance; a new object that reuses a
    name has a new id. Frames without objects have no line, so the file does not contain the number of frames.
    """
    ids: dict[tuple[str, int], int] = {}
    with path.open("w", encoding="utf-8") as file:
        for track in (track for frame in frames for track in frame.tracks):
            number = ids.setdefault((track.object, track.began), len(ids) + 1)
            if track.box is not None:
                x, y, w, h = track.box
                box = f"{x + 1:.2f},{y + 1:.2f},{w:.2f},{h:.2f}"
                file.write(f"{track.source_frame + 1},{number},{box},{track.score:.4f},-1,-1,-1\n")


def write_csv(frames: Iterable[TrackedFrame], path: Path, _: About) -> None:
    """Write the CSV file of a run, for spreadsheets and pandas."""
    with closing(CsvSink(str(path), Origin())) as sink:
        for frame in frames:
            sink.write(frame)


def write_sqlite(frames: Iterable[TrackedFrame], path: Path, about: About) -> None:
    write_database(frames, path, about.header)


@dataclass(frozen=True, slots=True)
class Format:
    """A row of the table.

    write    function that writes the frames to a path, and may return a note for the user; it may iterate repeatedly
    meaning  a line of the help
    suffix   suffix of the file; empty for a folder
    sized    whether the format has classes and requires the size of a frame
    images   whether the format refers to the images of the source
    """

    write: Callable[[Iterable[TrackedFrame], Path, About], str | None]
    meaning: str
    suffix: str = ""
    sized: bool = False
    images: bool = False


#: Formats by name.
EXPORTS = {
    "mot": Format(write_mot, "MOT text: frame,id,x,y,w,h,score,-1,-1,-1, counted from 1", ".txt"),
    "csv": Format(write_csv, "the CSV file of a run", ".csv"),
    "sqlite": Format(write_sqlite, "the table tracks of a database", ".sqlite"),
    "coco": Format(write_coco, "COCO, with the tracks and the video as in TAO", ".json", sized=True, images=True),
    "cvat": Format(write_cvat, "CVAT for video 1.1", ".xml", sized=True, images=True),
    "yolo": Format(write_yolo, "a folder: labels of each frame, and data.yaml", sized=True, images=True),
    "via": Format(write_via, "VIA tracks, which movement and napari open", ".via.csv", images=True),
}


def export_of(path: Path, name: str | None) -> Format:
    """Return a format by its name, or by the longest matching suffix; raises VideoError if it is unknown."""
    formats = [form for form in EXPORTS.values() if form.suffix and path.name.endswith(form.suffix)]
    if name is None and not formats:
        raise VideoError(f"unknown format of {path}: pass --format, one of {', '.join(EXPORTS)}")
    return max(formats, key=lambda form: len(form.suffix)) if name is None else EXPORTS[name]


def check_export(path: Path, form: Format, *, overwrite: bool, log: Path) -> None:
    """Raise VideoError if an export would replace files, unless `overwrite`.

    The images of a data set may exist before its labels.
    """
    if form.suffix:
        check_result(path, overwrite=overwrite, source=str(log))
        return
    entries = path.iterdir() if path.is_dir() else ()
    if not overwrite and any(entry.name != "images" and not entry.name.startswith(".") for entry in entries):
        raise VideoError(f"the folder {path} is not empty: replace its labels with --overwrite, or use another folder")


def export(frames: Iterable[TrackedFrame], path: Path, form: Format, about: About) -> str:
    """Convert the frames of a log to a file, which is created atomically, or to the files of a folder.

    Returns a note for the user, or "". Raises VideoError if the files cannot be written, or if the format requires the
    size of a frame and it is unknown.
    """
    if form.sized and about.size is None:
        raise VideoError(
            f"unknown size of the frames, required for {path}: pass the video or folder that was tracked (--source)"
        )
    with writing(path, VideoError):
        if not form.suffix:
            return form.write(frames, path, about) or ""
        remove_parts(path)
        part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
        try:
            note = form.write(frames, part, about)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    return note or ""

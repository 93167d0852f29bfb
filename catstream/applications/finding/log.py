"""The log of a search: every step is appended to a file, so that an interrupted search continues where it was."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import numpy as np

from catstream.applications.finding.files import File
from catstream.applications.finding.search import Step
from catstream.applications.finding.sightings import FileResult, Sighting
from catstream.box import Box
from catstream.errors import ServiceError
from catstream.messages.storage import writing
from catstream.video.frames import jpeg

_KIND = "catstream find 2"  # and the version of the lines
_GAP_SECONDS = 1.0  # longest time between two sightings of an interval, if steps are short
_GAP_STEPS = 2.5  # longest time between two sightings of an interval, in steps, if these are long
_PICTURE = 240  # side of a picture in pixels
_SURROUNDINGS = 1.7  # side of a picture, as a multiple of the longer side of the object's box


class SearchLog:
    """The results of all files, and the file of JSON lines in which they are stored. Use it in a `with`.

    Parameters
    ----------
    path : of the file; it is continued if it exists
    search : models and options; a file of another search is not continued
    overwrite : start again from nothing

    Raises
    ------
    ServiceError
        If the file is of another search, is no such file, or cannot be written.
    """

    def __init__(self, path: Path, search: Mapping[str, Any], *, overwrite: bool = False) -> None:
        self.path, self.search = path, search
        self.results: dict[str, FileResult] = {}
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            good = 0 if overwrite or not path.exists() else self._load(path.read_bytes())
            self._stream = path.open("ab")
            self._stream.truncate(good)  # the last line of a process that was killed may be incomplete
            if not good:
                self._write({"kind": _KIND, "search": search})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def begin(self, file: File) -> FileResult:
        """The result of a file: the stored one if the file has not changed since, otherwise an empty one."""
        signature, path = file.signature, str(file.path)
        known = self.results.get(path)
        if known is None or known.signature != signature:
            line = {"file": path, "signature": signature}
            self._apply(line)
            self._write(line)
        return self.results[path]

    def step(self, result: FileResult, step: Step) -> None:
        """Add a step to a result, with a picture of each sighting that is the best of its interval so far."""
        seen = []
        intervals = result.add(step.frame, step.time, step.sightings)
        for sighting, image, interval in zip(step.sightings, step.images, intervals, strict=True):
            if interval.best is sighting:
                interval.picture = _picture(image, sighting.box)
            picture = interval.picture if interval.best is sighting else b""
            seen.append(asdict(sighting) | {"picture": base64.b64encode(picture).decode("ascii")})
        self._write({"of": result.file, "step": step.frame, "time": step.time, "seen": seen})

    def note(self, result: FileResult, **facts: Any) -> None:
        """Store facts of a result: `frames`, a `problem`, or that it is `complete`."""
        if facts.get("problem") in result.problems:  # it was noted before an interruption
            return
        line = {"of": result.file, **facts}
        self._apply(line)
        self._write(line)

    def _write(self, line: Mapping[str, Any]) -> None:
        try:
            self._stream.write(json.dumps(line, separators=(",", ":")).encode() + b"\n")
            self._stream.flush()
        except OSError as error:
            raise ServiceError(
                f"cannot write {str(self.path)!r} ({error.strerror}): the results so far are kept, and the "
                "same command continues"
            ) from None

    def _load(self, data: bytes) -> int:
        """Read the complete lines of a file; returns their length in bytes."""
        lines = data[: data.rfind(b"\n") + 1].splitlines()
        if not lines:
            return 0
        try:
            head, *rest = map(json.loads, lines)
            if head["kind"] != _KIND:
                raise ValueError(f"it is of kind {head['kind']!r}, not {_KIND!r}")
            if head["search"] == self.search:
                for line in rest:
                    self._apply(line)
        except (AttributeError, KeyError, TypeError, ValueError, binascii.Error) as error:
            raise ServiceError(
                f"{str(self.path)!r} is not the log of a search ({error}): give another folder, or --overwrite"
            ) from None
        if head["search"] != self.search:
            changed = ", ".join(name for name in self.search if head["search"].get(name) != self.search[name])
            raise ServiceError(
                f"{str(self.path.parent)!r} has the results of a search that differs in {changed or 'version'}: give "
                "another folder, or replace them with --overwrite"
            )
        return data.rfind(b"\n") + 1

    def _apply(self, line: Mapping[str, Any]) -> None:
        """Change the results as a line says."""
        if "file" in line:
            gap = max(_GAP_SECONDS, _GAP_STEPS * self.search["every"])
            self.results[line["file"]] = FileResult(line["file"], line["signature"], gap)
            return
        result = self.results[line["of"]]
        result.frames = line.get("frames", result.frames)
        result.complete = line.get("complete", result.complete)
        result.problems += [line["problem"]] if "problem" in line else []
        if "step" in line:
            pictures = [each.pop("picture") for each in line["seen"]]
            sightings = [Sighting(**each | {"box": Box(*each["box"])}) for each in line["seen"]]
            intervals = result.add(line["step"], line["time"], sightings)
            for interval, picture in zip(intervals, pictures, strict=True):
                interval.picture = base64.b64decode(picture) or interval.picture


def _picture(image: np.ndarray, box: Box) -> bytes:
    """A small square JPEG of an object with some of its surroundings."""
    height, width = image.shape[:2]
    side = round(np.clip(max(box.w, box.h) * _SURROUNDINGS, 16, min(width, height)))
    left, top = (round(centre - side / 2) for centre in box.centre)
    left, top = int(np.clip(left, 0, width - side)), int(np.clip(top, 0, height - side))
    return jpeg(image[top : top + side, left : left + side], _PICTURE)

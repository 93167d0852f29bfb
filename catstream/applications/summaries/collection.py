"""A collection of images: the images of a folder and its subfolders, and every frame of its videos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catstream.applications.finding.find import find_files
from catstream.errors import VideoError
from catstream.video.source import IMAGES, open_source, read_image


@dataclass(frozen=True, slots=True)
class Origin:
    """The place of an image in a collection.

    file   path of the file, relative to the folder
    frame  number of the frame, None if the file is an image
    time   its seconds in the video, None if the file is an image
    """

    file: str
    frame: int | None = None
    time: float | None = None


class Collection:
    """All images below a folder in natural order, or the frames of a video; only one of them is in memory at a time.

    Attributes
    ----------
    names : paths of the images and videos, relative to the folder
    opened : number of files that were opened
    skipped : descriptions of the images and videos that could not be read, in order

    Raises
    ------
    VideoError
        If there are no images; while iterating, if the only file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._paths = [each for file in find_files([path]) for each in file.paths()]
        self.names = [str(each.relative_to(path if path.is_dir() else path.parent)) for each in self._paths]
        self.opened = 0
        self.skipped: list[str] = []

    def __iter__(self) -> Iterator[tuple[Origin, np.ndarray]]:
        for path, name in zip(self._paths, self.names, strict=True):
            self.opened += 1
            try:
                if path.suffix.lower() not in IMAGES:
                    yield from self._frames(path, name)
                elif (image := read_image(path)) is not None:
                    yield Origin(name), image
                else:
                    raise VideoError("not an image that can be read")
            except VideoError as error:
                reason = f"{name}: {str(error).partition(': give')[0]}"  # a stream cannot be given here
                if len(self.names) == 1:
                    raise VideoError(f"{reason}: give a folder of images, or a video file") from None
                self.skipped.append(reason)

    def _frames(self, path: Path, name: str) -> Iterator[tuple[Origin, np.ndarray]]:
        with open_source(path, skip_damaged=True) as source:
            for frame in source:
                yield Origin(name, frame.number, frame.time), frame.image
            if damaged := source.counters.get("damaged"):
                self.skipped.append(f"{name}: {damaged:.0f} damaged frames")

"""A collection of images: the files of a folder and its subfolders, and every frame of its videos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catstream.errors import VideoError
from catstream.video.source import IMAGES, VIDEOS, is_live, natural_order, open_source, read_image

__all__ = ["Collection", "Origin"]


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
    files, names : files of the collection, and their paths relative to the folder
    opened : number of files that were opened
    skipped : descriptions of the images and videos that could not be read, in order

    Raises
    ------
    VideoError
        If there are no images.
    """

    def __init__(self, path: Path) -> None:
        self.files = _files(path)
        self.opened = 0
        self.skipped: list[str] = []
        folder = path if path.is_dir() else path.parent
        self.names = [str(file.relative_to(folder)) for file in self.files]

    def __iter__(self) -> Iterator[tuple[Origin, np.ndarray]]:
        for file, name in zip(self.files, self.names, strict=True):
            self.opened += 1
            if file.suffix.lower() in VIDEOS:
                yield from self._frames(file, name)
            elif (image := read_image(file)) is not None:
                yield Origin(name), image
            else:
                self.skipped.append(f"{name}: not an image that can be read")

    def _frames(self, file: Path, name: str) -> Iterator[tuple[Origin, np.ndarray]]:
        try:
            with open_source(file, skip_damaged=True) as source:
                for frame in source:
                    yield Origin(name, frame.number, frame.time), frame.image
                if damaged := source.counters.get("damaged"):
                    self.skipped.append(f"{name}: {damaged:.0f} damaged frames")
        except VideoError as error:
            self.skipped.append(f"{name}: {error}")


def _files(path: Path) -> list[Path]:
    kinds = IMAGES | VIDEOS
    if is_live(str(path)):
        raise VideoError(f"{str(path)!r} is a live source: record it to a file first, and summarise the file")
    if not path.exists():
        raise VideoError(f"there is no folder or video {str(path)!r}: give a folder of images, or a video file")
    if path.is_file():
        if path.suffix.lower() not in kinds:
            raise VideoError(f"{str(path)!r} is neither an image nor a video: give a folder of images, or a video file")
        return [path]
    found = [
        file
        for file in path.rglob("*")
        if file.suffix.lower() in kinds
        and file.is_file()
        and not any(part.startswith(".") for part in file.relative_to(path).parts)
    ]
    if not found:
        shown = ", ".join(sorted(suffix[1:] for suffix in kinds))
        raise VideoError(f"there are no images or videos in {str(path)!r} ({shown}): give another folder")
    return sorted(found, key=lambda file: [natural_order(Path(part)) for part in file.relative_to(path).parts])

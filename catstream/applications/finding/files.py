"""The files that are searched: videos, folders of images, and single images."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from catstream.errors import VideoError
from catstream.settings import RunSettings
from catstream.video.frames import Frame, read_ahead, without_password
from catstream.video.source import IMAGES, VIDEOS, image_files, is_live, natural_order, open_source, read_image

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class File:
    """A video, a folder of images, or a single image.

    path  of the file, or of the folder
    kind  "video", "images" or "image"
    """

    path: Path
    kind: Literal["video", "images", "image"]

    @property
    def signature(self) -> list[int]:
        """Number of files, their total size, and the newest time of modification: it differs if the file changed."""
        states = [path.stat() for path in self.paths() if path.exists()]  # a dead link is a damaged image
        newest = max((state.st_mtime_ns for state in states), default=0)
        return [len(states), sum(state.st_size for state in states), newest]

    def frames(
        self,
        start: int,
        settings: RunSettings,
        opened: Callable[[float, int | None], None],
        damaged: Callable[[str], None],
    ) -> Iterator[tuple[Frame, str]]:
        """Yield the frames from number `start` on, each with the name of its file in a folder of images.

        Parameters
        ----------
        opened : function that is called with the frame rate and the number of frames, if known, before the first frame
        damaged : function that is called with the reason for each image that cannot be read, and at the end of a video
            of which frames were skipped

        Raises
        ------
        VideoError
            If a video cannot be opened, or at its damage, after the frames before it.
        """
        if self.kind == "video":
            with open_source(self.path, start, settings=settings) as source:
                opened(source.rate, source.frames)
                with closing(read_ahead(source)) as frames:
                    yield from ((frame, "") for frame in frames)
                if skipped := source.counters.get("damaged"):
                    damaged(f"{str(self.path)!r} is damaged: {skipped:.0f} of its frames were skipped")
            return
        images = self.paths()
        opened(settings.image_rate, len(images))
        for number, path in enumerate(images[start:], start):
            image = read_image(path)
            if image is None:
                damaged(f"cannot read the image {str(path)!r}: it is left out")
            else:
                yield Frame(number, number / settings.image_rate, image), path.name if self.kind == "images" else ""

    def paths(self) -> list[Path]:
        """The video, or the images in order."""
        return image_files(self.path) if self.kind == "images" else [self.path]


def find_files(paths: Iterable[str | os.PathLike[str]]) -> list[File]:
    """Return the files to search, in order and each once; folders are searched with all their subfolders.

    The images of one folder are one file, in natural order (2.png before 10.png).

    Raises
    ------
    VideoError
        If a path does not exist, is a live source, or has neither images nor videos.
    """
    found: dict[File, None] = {}
    for path in paths:
        if is_live(str(path)):
            raise VideoError(
                f"{without_password(str(path))} is a live source: record it to a video first, and give the video"
            )
        found |= dict.fromkeys(_files(Path(path)))
    return list(found)


def _files(path: Path) -> list[File]:
    if path.is_file():
        return [File(path, "image" if path.suffix.lower() in IMAGES else "video")]
    if not path.is_dir():
        raise VideoError(f"there is no file or folder {str(path)!r}: give videos, images, or folders of them")
    found = list(_files_below(path))
    if not found:
        raise VideoError(
            f"the folder {str(path)!r} and its subfolders hold neither images nor videos: give another folder"
        )
    return found


def _files_below(folder: Path) -> Iterator[File]:
    entries = sorted((entry for entry in folder.iterdir() if not entry.name.startswith(".")), key=natural_order)
    if any(entry.suffix.lower() in IMAGES and entry.is_file() for entry in entries):
        yield File(folder, "images")
    for entry in entries:
        if entry.is_dir() and not entry.is_symlink():
            try:
                yield from _files_below(entry)
            except PermissionError as error:
                _log.warning("%s is left out (%s)", error.filename, error.strerror)
        elif entry.suffix.lower() in VIDEOS and entry.is_file():
            yield File(entry, "video")

"""Collects and reads the files of a search: videos, images and folders of images."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from catstream.base.addresses import is_live, without_password
from catstream.base.settings import RunSettings
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.video.frames import Frame, read_ahead
from catstream.video.images import IMAGES, ImageReader, first_pages, natural_order, pages_of
from catstream.video.source import VIDEOS, open_source

#: A frame, and the name of its file in a folder of images.
NamedFrame = tuple[Frame, str]

_READING = RunSettings(skip_damaged=True)
_TIME_STEP = 0.001  # resolution of the time stamps in most containers, in seconds

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class File:
    """A video, a folder of images, or a single image.

    path   path of the file or folder
    pages  file and page number of each image, in order; empty for a video
    """

    path: Path
    pages: tuple[tuple[Path, int], ...] = ()

    def frames(self, every: float, problems: list[str]) -> Generator[NamedFrame]:
        """Yield the frames to search: all images, or the first frame of a video in each `every` seconds.

        Damaged images and damaged parts of a video are skipped, and added to `problems`. VideoError if a video cannot
        be opened.
        """
        return self._of_images(problems) if self.pages else self._of_video(every, problems)

    def _of_video(self, every: float, problems: list[str]) -> Generator[NamedFrame]:
        with open_source(self.path, settings=_READING, resize=True) as source:
            interval = -1.0
            with closing(read_ahead(source)) as frames:
                for frame in frames:
                    # By time, because the frame rate of a file may be wrong or variable.
                    previous, interval = interval, (frame.time + _TIME_STEP) // every if every else frame.number
                    if interval != previous:
                        yield frame, ""
            if scaled := source.counters.get("scaled"):
                _log.warning("%s: %s of another size, scaled to the first", self.path, counted(scaled, "frame"))
            if skipped := source.counters.get("damaged"):
                problems.append(f"{str(self.path)!r} is damaged: {skipped:.0f} of its frames were skipped")
            if missing := source.counters.get("truncated"):
                problems.append(f"{str(self.path)!r} is truncated: it lacks {missing:.0f} s at the end")

    def _of_images(self, problems: list[str]) -> Generator[NamedFrame]:
        read_image = ImageReader([*self.pages])
        for number, (path, _) in enumerate(self.pages):
            image = read_image(number)
            if image is None:
                problems.append(f"cannot read the image {str(path)!r}: it is skipped")
            else:
                yield Frame(number, number / _READING.image_rate, image), "" if path == self.path else path.name


def find_files(paths: Iterable[str | os.PathLike[str]]) -> list[File]:
    """Return the files to search, in order; folders are searched with their subfolders, except hidden ones.

    Each file and folder is searched once, even if links refer to it. The images of a folder are one file, in natural
    order (2.png before 10.png). Files of other types are counted in the log.
    """
    visited: set[Path] = set()
    skipped: Counter[str] = Counter()

    def is_new(path: Path) -> bool:
        known = (target := path.resolve()) in visited
        visited.add(target)
        return not known

    def below(folder: Path) -> Iterator[File]:
        try:
            entries = sorted((entry for entry in folder.iterdir() if entry.name[0] != "."), key=natural_order)
        except PermissionError:
            yield File(folder)  # reading it will raise the error
            return
        if images := [entry for entry in entries if _is_image(entry) and is_new(entry)]:
            yield File(folder, tuple(first_pages(images)))
        for entry in entries:
            if entry.is_dir() or entry.suffix.lower() in VIDEOS:
                if is_new(entry):
                    yield from below(entry) if entry.is_dir() else [File(entry)]
            elif not _is_image(entry):
                skipped[entry.suffix.lower() or "file without a suffix"] += 1

    files: list[File] = []
    for name in paths:
        path = Path(name)
        if is_live(str(name)) or not path.exists():
            raise VideoError(
                f"there is no file or folder {without_password(str(name))!r}: pass recorded videos, images, or folders"
            )
        if is_new(path):
            files += below(path) if path.is_dir() else [File(path, tuple(pages_of(path)))]
    kinds = ", ".join(f"{number} {suffix}" for suffix, number in skipped.most_common())
    if not files:
        raise VideoError(
            f"the folders contain no images or videos{kinds and f' ({kinds})'}: pass other folders, or name a file"
        )
    if skipped:
        _log.warning("not searched: %s (name a file to search it)", kinds)
    return files


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGES and not path.is_dir()

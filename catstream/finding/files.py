"""The files that a search reads: videos, images and folders of images, each once."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from catstream.base.addresses import is_live, without_password
from catstream.base.settings import RunSettings
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.video.frames import Frame, read_ahead
from catstream.video.images import IMAGES, ImageReader, first_pages, natural_order, pages_of, visible
from catstream.video.source import VIDEOS, open_source

#: A frame that is searched, and the name of its file in a folder of images.
NamedFrame = tuple[Frame, str]

_TIME_STEP = 0.001  # of most containers, in seconds: time stamps are rounded to it
#: Folders of thumbnails, recycle bins and metadata, in lower case; hidden folders are skipped, too.
_GENERATED = {
    *("@eadir", "@__thumb", "thumbnails", "thumbs", "__macosx"),
    *("#recycle", "@recycle", "$recycle.bin", "system volume information"),
}

_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class Reading:
    """The length and the problems of a file, which become known while it is read.

    frames    number of its frames, None if unknown
    problems  reasons for what could not be read: each image, or at the end of a video the frames that were skipped
    """

    frames: int | None = None
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class File:
    """A video, a folder of images, or a single image.

    path   of the file, or of the folder
    kind   "video", "images" or "image"
    files  the video, or the images in order
    """

    path: Path
    kind: Literal["video", "images", "image"]
    files: tuple[Path, ...]

    @property
    def signature(self) -> list[int]:
        """Number of files, their total size, and the newest time of modification: it differs if the file changed."""
        states = [path.stat() for path in self.files if path.exists()]  # a dead link is a damaged file
        newest = max((state.st_mtime_ns for state in states), default=0)
        return [len(states), sum(state.st_size for state in states), newest]

    def frames(self, every: float, settings: RunSettings, reading: Reading) -> Generator[NamedFrame]:
        """Yield the frames to search: all images; of a video the first one in each `every` seconds, and the last one.

        A video that is damaged raises VideoError after the frames before the damage.
        """
        if self.path.is_symlink() and not self.path.exists():
            raise VideoError(f"{str(self.path)!r} is a dead link: {str(self.path.readlink())!r} does not exist")
        if self.kind == "video":
            # Not in equal numbers of frames: the rate of a file may be nominal, and its frames need not be regular.
            with open_source(self.path, settings=settings, resize=True) as source:
                reading.frames = source.frames
                before, last = -1.0, None
                with closing(read_ahead(source)) as frames:
                    for frame in frames:
                        interval = (frame.time + _TIME_STEP) // every if every else frame.number
                        last = frame if interval == before else None
                        if last is None:
                            yield frame, ""
                        before = interval
                if last is not None:
                    yield last, ""
                if scaled := source.counters.get("scaled"):
                    _log.warning("%s: %s of another size, scaled to the first", self.path, counted(scaled, "frame"))
                if skipped := source.counters.get("damaged"):
                    reading.problems.append(f"{str(self.path)!r} is damaged: {skipped:.0f} of its frames were skipped")
                if missing := source.counters.get("truncated"):
                    reading.problems.append(f"{str(self.path)!r} is truncated: it lacks {missing:.0f} s at the end")
            return
        pages = first_pages([*self.files]) if self.kind == "images" else pages_of(self.path)
        reading.frames = len(pages)
        read_image = ImageReader(pages)
        for number, (path, _) in enumerate(pages):
            image = read_image(number)
            if image is None:
                reading.problems.append(f"cannot read the image {str(path)!r}: it is left out")
            else:
                yield Frame(number, number / settings.image_rate, image), path.name if self.kind == "images" else ""


def find_files(paths: Iterable[str | os.PathLike[str]]) -> list[File]:
    """Return the files to search, in order; folders are searched with all their subfolders.

    Each file and folder is searched once, even if links lead to it. The images of one folder are one file, in natural
    order (2.png before 10.png). A dead link is a file that cannot be read.
    """
    walk = _Walk()
    return [file for path in paths for file in walk.files(path)]


class _Walk:
    """A walk through folders that visits each file once."""

    def __init__(self) -> None:
        self._visited: set[tuple[int, int]] = set()
        self._skipped: Counter[str] = Counter()

    def files(self, name: str | os.PathLike[str]) -> list[File]:
        """Return the files of a path that were not visited before."""
        path = Path(name)
        if is_live(str(name)):
            raise VideoError(
                f"{without_password(str(name))} is a live source: record it to a video first, and pass the video"
            )
        if path.is_file():
            return [File(path, "image" if pages_of(path) else "video", (path,))] if self._is_new(path) else []
        if not path.is_dir():
            raise VideoError(f"there is no file or folder {str(path)!r}: pass videos, images, or folders of them")
        self._skipped.clear()
        is_new = self._is_new(path)
        files = [*self._below(path)] if is_new else []
        skipped = ", ".join(counted(number, kind) for kind, number in (+self._skipped).most_common())
        if is_new and not files and not self._skipped["duplicate"]:
            raise VideoError(
                f"the folder {str(path)!r} and its subfolders hold neither images nor videos"
                f"{skipped and f' ({skipped})'}: pass another folder, or name the files"
            )
        if skipped:
            _log.warning("not searched in %s: %s (name a file or folder to search it)", path, skipped)
        return files

    def _is_new(self, path: Path) -> bool:
        """Return True if a file or folder was not visited before, by any name; a dead link is new."""
        try:
            state = path.stat()
        except OSError:
            return True
        place = state.st_dev, state.st_ino
        if place in self._visited:
            self._skipped["duplicate"] += 1
            return False
        self._visited.add(place)
        return True

    def _below(self, folder: Path) -> Iterator[File]:
        entries = sorted(folder.iterdir(), key=natural_order)
        images = [entry for entry in visible(folder, IMAGES) if not entry.is_dir()]
        if images := [image for image in sorted(images, key=natural_order) if self._is_new(image)]:
            yield File(folder, "images", tuple(images))
        for entry in entries:
            suffix = entry.suffix.lower()
            if entry.name.startswith("."):
                self._skipped["hidden folder"] += entry.is_dir()
            elif entry.is_dir():
                if entry.name.lower() in _GENERATED:
                    self._skipped[f"{entry.name} folder"] += 1
                elif self._is_new(entry):
                    try:
                        yield from self._below(entry)
                    except PermissionError:
                        yield File(entry, "video", (entry,))  # an error when it is read
            elif suffix in VIDEOS or (entry.is_symlink() and not suffix and not entry.exists()):
                if self._is_new(entry):
                    yield File(entry, "video", (entry,))
            elif suffix not in IMAGES:
                self._skipped[f"{suffix} file" if suffix else "file without a suffix"] += 1

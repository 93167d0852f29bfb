"""The files that a search reads: videos, images and folders of images, each once."""

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

#: A frame that is searched, and the name of its file in a folder of images.
NamedFrame = tuple[Frame, str]

_TIME_STEP = 0.001  # of most containers, in seconds: time stamps are rounded to it
#: Folders of thumbnails, recycle bins and metadata, in lower case; hidden folders are skipped as well.
_GENERATED = {
    *("@eadir", "@__thumb", "thumbnails", "thumbs", "__macosx"),
    *("#recycle", "@recycle", "$recycle.bin", "system volume information"),
}

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class File:
    """A video, a folder of images, or a single image.

    path   of the file, or of the folder
    pages  each image in order, and the number of its page; empty for a video
    """

    path: Path
    pages: tuple[tuple[Path, int], ...] = ()

    def frames(self, every: float, settings: RunSettings, problems: list[str]) -> Generator[NamedFrame]:
        """Yield the frames to search: all images; of a video the first one in each `every` seconds, and the last one.

        A video that is damaged raises VideoError after the frames before the damage. What else could not be read, an
        image or frames of a video that were skipped, is added to `problems`.
        """
        if self.path.is_symlink() and not self.path.exists():
            raise VideoError(f"{str(self.path)!r} is a dead link: {str(self.path.readlink())!r} does not exist")
        return self._of_images(settings, problems) if self.pages else self._of_video(every, settings, problems)

    def _of_video(self, every: float, settings: RunSettings, problems: list[str]) -> Generator[NamedFrame]:
        # Not in equal numbers of frames: the rate of a file may be nominal, and its frames need not be regular.
        with open_source(self.path, settings=settings, resize=True) as source:
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
                problems.append(f"{str(self.path)!r} is damaged: {skipped:.0f} of its frames were skipped")
            if missing := source.counters.get("truncated"):
                problems.append(f"{str(self.path)!r} is truncated: it lacks {missing:.0f} s at the end")

    def _of_images(self, settings: RunSettings, problems: list[str]) -> Generator[NamedFrame]:
        read_image = ImageReader([*self.pages])
        for number, (path, _) in enumerate(self.pages):
            image = read_image(number)
            if image is None:
                problems.append(f"cannot read the image {str(path)!r}: it is left out")
            else:
                yield Frame(number, number / settings.image_rate, image), "" if path == self.path else path.name


def find_files(paths: Iterable[str | os.PathLike[str]]) -> list[File]:
    """Return the files to search, in order; folders are searched with all their subfolders.

    Each file and folder is searched once, even if links lead to it. The images of one folder are one file, in natural
    order (2.png before 10.png). A dead link is a file that cannot be read. Files of other kinds are counted in the log.
    """
    visited: set[Path] = set()
    skipped: Counter[str] = Counter()

    def is_new(path: Path) -> bool:
        known = (target := path.resolve()) in visited
        visited.add(target)
        return not known

    def below(folder: Path) -> Iterator[File]:
        entries = [entry for entry in folder.iterdir() if entry.name[0] != "." and entry.name.lower() not in _GENERATED]
        entries.sort(key=natural_order)
        images = [entry for entry in entries if entry.suffix.lower() in IMAGES and not entry.is_dir()]
        if new := [*filter(is_new, images)]:
            yield File(folder, tuple(first_pages(new)))
        for entry in entries:
            if entry.is_dir():
                try:
                    yield from below(entry) if is_new(entry) else ()
                except PermissionError:
                    yield File(entry)  # an error when it is read
            elif entry.suffix.lower() in VIDEOS or (not entry.suffix and not entry.exists()):
                yield from [File(entry)] if is_new(entry) else ()
            elif entry.suffix.lower() not in IMAGES:
                skipped[entry.suffix.lower() or "file without a suffix"] += 1

    files: list[File] = []
    for name in paths:
        path = Path(name)
        if is_live(str(name)):
            raise VideoError(
                f"{without_password(str(name))} is a live source: record it to a video first, and pass the video"
            )
        if not path.exists():
            raise VideoError(f"there is no file or folder {str(path)!r}: pass videos, images, or folders of them")
        if is_new(path):
            files += below(path) if path.is_dir() else [File(path, tuple(pages_of(path)))]
    kinds = ", ".join(f"{number} {suffix}" for suffix, number in skipped.most_common())
    if not files:
        raise VideoError(
            f"the folders hold neither images nor videos{kinds and f' ({kinds})'}: pass other folders, or name a file"
        )
    if skipped:
        _log.warning("not searched: %s (name a file to search it)", kinds)
    return files

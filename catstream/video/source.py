"""Opens a source of frames from the text that a user types.

    with open_source("walk.mp4") as source:
        for frame in source:
            print(frame.number, frame.time, frame.image.shape)

The text is one of these:

    a video file        any format that FFmpeg reads; every frame is read once, in order
    an image file       its pages
    a folder            its images in natural order (2.png before 10.png), or the images of its `img`, `color` or `rgb`
                        folder, or its only video; sequence folders of the public benchmarks open unchanged
    a pattern           images/%05d.png or images/*.png
    a camera            0 or /dev/video0
    a stream            rtsp://HOST/PATH, http://HOST/PATH for MJPEG, or another address that FFmpeg opens
    a live demo         demo:1; it needs no camera, see `catstream.video.live_demo`
    a file:// address   file:///home/me/walk.mp4

Files and images are read to the last frame, and no frame is skipped. If FFmpeg cannot decode a part of a file, the
frames before it are returned and then `VideoError` is raised; with `run.skip_damaged`, reading continues at the next
keyframe. The other sources are live: see `catstream.video.live`.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Generator
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from catstream.base.addresses import is_live, without_password
from catstream.base.settings import RunSettings
from catstream.errors import VideoError
from catstream.video.frames import Frame, Source
from catstream.video.images import (
    EXPECTED,
    IMAGES,
    ImageReader,
    first_pages,
    image_files,
    of_one_size,
    pages_of,
    visible,
)
from catstream.video.video_file import VideoFile

#: All frames of a source.
ALL_FRAMES = slice(None)

#: Suffixes of the files in a folder that are read as videos. FFmpeg reads a single file with any suffix.
_VIDEOS = (
    "264 265 266 3g2 3gp amv apng asf av1 avc avi avs2 avs3 cavs dav dif divx drc dv dvd dvr-ms f4v flc fli flv gif "
    "gxf h261 h263 h264 h265 h266 h26l hevc imx ismv ivf k3g lvf m1v m2p m2t m2ts m2v m4v mj2 mjpeg mjpg mk3d mkv mod "
    "moflex mov mp2v mp4 mp4v mpe mpeg mpg mpv mpv2 mts mxf mxg nsv nut obu ogm ogv psp qt rcv rm rmvb roq swf tod tp "
    "trp ts vc1 vdr viv vob vro vvc webm wm wmv wtv xesc y4m"
)
VIDEOS = {f".{suffix}" for suffix in _VIDEOS.split()}
_FOLDERS = ("img", "imgs", "color", "rgb")


class FileSource(Source):
    """The frames of a `part` of a file or of images, from number `start` on. The constructor decodes the first one."""

    def __init__(self, name: str, reader: Images | VideoFile, part: slice, start: int) -> None:
        self.reader, self._part = reader, part
        numbers = range(sys.maxsize)[part]
        self._frames = reader.frames(numbers, start)
        self._first: Frame | None = next(self._frames, None)
        if self._first is None and numbers[start:].start == 0:
            raise VideoError(f"no frame of {name} can be decoded (no keyframe): {EXPECTED}")
        if self._first is None:
            raise VideoError(
                f"the first frame, {numbers[start:].start}, is after the end of {name} ({reader.count() or 'no'} "
                "frames): choose an earlier first frame, or another source"
            )
        height, width = self._first.image.shape[:2]
        super().__init__(name, reader.rate / (part.step or 1), (width, height))
        self.pixel_aspect, self.images = reader.pixel_aspect, reader.images

    @cached_property
    def frames(self) -> int | None:
        total = self.reader.count()
        return len(range(total)[self._part]) if total else None

    @property
    def counters(self) -> dict[str, float]:
        return counters_of(self.reader)

    def __next__(self) -> Frame:
        if self._first is not None:
            frame, self._first = self._first, None
            return frame
        return next(self._frames)

    def close(self) -> None:
        self._first = None
        self._frames.close()


def counters_of(reader: Images | VideoFile) -> dict[str, float]:
    """The counters of a reader that are not 0.

    damaged    number of skipped packets, one for each frame
    scaled     number of frames that were scaled to the size of the first one
    truncated  seconds missing at the end
    """
    names = ("damaged", "scaled", "truncated")
    return {name: count for name in names if (count := getattr(reader, name))}


def open_source(
    text: str | Path,
    start: int = 0,
    *,
    part: slice = ALL_FRAMES,
    since: float | None = None,
    rate: float | None = None,
    idle: Callable[[], bool] | None = None,
    settings: RunSettings | None = None,
    **single: Any,
) -> Source:
    """Open the source that `text` names; the docstring of the module lists the kinds.

    start     number of the first frame to return, counted within the part. In a file, the frames before it are decoded
              and dropped; a live source numbers its first frame `start`
    part      the frames of a file or folder that are read, for example `slice(100, 200, 2)` for 100, 102 ... 198
    since     value of `time.monotonic` at time 0 of a live source; None for its first frame
    rate      frames per second of a live source; None to let FFmpeg measure it for half a second
    idle      is called ten times a second while a live source has no frame; if it returns True, iteration ends. With
              it, opening a live source never fails: iteration waits for the first frame without a timeout, and the size
              is unknown until then
    settings  the settings of a run; `image_rate`, `hwaccel`, `skip_damaged` and `resize` are used
    single    single settings by name, which override `settings`

    VideoError if the source does not exist or cannot be read. The iterator raises it where a frame cannot be decoded.
    """
    settings = (settings or RunSettings()).replace(**single)
    if min(part.start or 0, part.stop or 0) < 0 or (part.step is not None and part.step < 1):
        raise VideoError(f"frames count from 0 and the stride from 1, got {part.start}, {part.stop}, {part.step}")
    if part.stop is not None and part.stop <= (part.start or 0):
        raise VideoError(f"the end ({part.stop}) must be greater than the start ({part.start or 0})")
    if is_live(text):
        if part != ALL_FRAMES:
            raise VideoError("a live source has no start, end or stride: its newest frame is tracked; omit them")
        # Imported here because files need neither threads nor the rendering of the demo.
        from catstream.video.live import LiveSource
        from catstream.video.live_demo import PREFIX, LiveDemo

        if str(text).startswith(PREFIX):
            return LiveDemo(str(text), start, settings.image_rate, since=since, idle=idle)
        return LiveSource(str(text), start, settings, since=since, rate=rate, idle=idle)
    redacted = without_password(str(text))
    if re.match(r"\w+:/[^/]", str(text)) and not Path(text).exists():
        raise VideoError(f"invalid address {redacted!r} (one slash after the protocol): write //")
    if str(text) == "-":
        raise VideoError(
            "standard input is not a source, because a restarted process cannot read it again: "
            "write the video to a file, or serve it as a stream"
        )
    try:
        name, reader = _open_reader(Path(source_text(text)), settings)
    except OSError as error:
        raise VideoError(f"cannot open {redacted!r} ({error.strerror}): {EXPECTED}") from None
    return FileSource(name, reader, part, start)


def _open_reader(path: Path, settings: RunSettings) -> tuple[str, Images | VideoFile]:
    """Open a file, a folder or a pattern; return its name for results, and its reader."""
    if path.is_dir():
        name = _folder_name(path)
        for folder in (*(path / inner for inner in _FOLDERS), path):
            if folder.is_dir() and visible(folder, IMAGES):
                return name, Images(first_pages(image_files(folder)), settings)
        videos = visible(path, VIDEOS)
        if len(videos) == 1:
            return videos[0].stem, VideoFile(videos[0], settings)
        content = f"{len(videos)} videos" if videos else "neither images nor a video"
        raise VideoError(f"the folder {str(path)!r} contains {content}: {EXPECTED}")
    if path.is_file():
        pages = pages_of(path)
        return path.stem, Images(pages, settings) if pages else VideoFile(path, settings)
    if re.search(r"%0?\d*d|[*?\[]", path.name):
        return _folder_name(path.parent), Images(first_pages(image_files(path)), settings)
    if path.exists():
        raise VideoError(
            f"{str(path)!r} is a pipe or a device, whose frames a restarted process cannot read again: "
            "write the video to a file, or serve it as a stream"
        )
    raise VideoError(f"there is no video or folder {without_password(str(path))!r}: {EXPECTED}")


def _folder_name(folder: Path) -> str:
    """The name of a folder of images for results; for an `img` folder, the name of the sequence."""
    folder = folder.resolve()
    return (folder.name in _FOLDERS and folder.parent.name) or folder.name


def source_text(source: object) -> str:
    """The text of a source argument; a local file:// address becomes its path.

    >>> source_text("file:///videos/a%20walk.mp4"), source_text(Path("walk.mp4")), source_text(0)
    ('/videos/a walk.mp4', 'walk.mp4', '0')
    """
    if not isinstance(source, (str, int, os.PathLike)):
        raise VideoError(
            f"a source is a path, an address or the number of a camera, got {type(source).__name__}: "
            "pass frames in memory to catstream.Tracker.update"
        )
    text = str(source)
    if not text.startswith("file://"):
        return text
    address = urlsplit(text)
    if address.netloc not in ("", "localhost"):
        raise VideoError(f"{text!r} names a file on another machine: copy it here, or pass file:///PATH")
    return unquote(address.path)


class Images:
    """Images as frames. `scaled` is the number of images that had another size than the first one."""

    damaged, truncated, pixel_aspect = 0, 0, Fraction(1)

    def __init__(self, pages: list[tuple[Path, int]], settings: RunSettings) -> None:
        self.settings, self.rate, self.scaled = settings, settings.image_rate, 0
        self._read_image = ImageReader(pages)
        files = [file for file, _ in pages]
        self.images = files if len({file.stem for file in files}) == len(files) else []

    def count(self) -> int:
        return len(self._read_image.pages)

    def frames(self, numbers: range, start: int) -> Generator[Frame]:
        """Yield the frames with these numbers, from index `start` on."""
        numbers = range(self.count())[numbers.start : numbers.stop : numbers.step]
        # The first image of the run sets the size, even if the run is resumed.
        shape = self.image(numbers[0]).shape if self.settings.resize and start and numbers else None
        for index, number in enumerate(numbers[start:], start):
            image = self.image(number, shape)
            shape = shape or image.shape
            yield Frame(index, number / self.rate, image)

    def image(self, number: int, shape: tuple[int, ...] | None = None) -> np.ndarray:
        """Return an image by its number, scaled to the shape of the first one if that is passed."""
        path, image = self._read_image.pages[number][0], self._read_image(number)
        if image is None:
            raise VideoError(f"cannot read the image {str(path)!r} (frame {number}): replace or remove it")
        scaled = of_one_size(image, shape or image.shape, self.settings.resize, path, number)
        self.scaled += scaled is not image
        return scaled


def prepare() -> None:
    """Import the modules that read a video in advance."""
    import av.video.reformatter  # noqa: F401

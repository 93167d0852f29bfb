"""Opens sources of frames. One text names the source, as a user types it.

    with open_source("walk.mp4") as source:
        for frame in source:
            print(frame.number, frame.time, frame.image.shape)

The text is one of these:

    a video file        any format that FFmpeg reads; every frame is read once, in order
    a folder            its images in natural order (2.png before 10.png), or those of its `img`, `color` or `rgb`
                        folder, or its only video; sequence folders of the public benchmarks open unchanged
    a pattern           images/%05d.png or images/*.png
    a camera            0 or /dev/video0
    a stream            rtsp://HOST/PATH, http://HOST/PATH for MJPEG, or another address that FFmpeg opens
    a live demo         demo:1; it needs no camera, see `catstream.video.live_demo`
    a file:// address   file:///home/me/walk.mp4

Files and images are read to the last frame, and no frame is skipped. If FFmpeg
cannot decode a place in a file, the frames before it are returned and then
`VideoError` is raised; with `run.skip_damaged`, reading continues at the next
key frame. The others are live: see `catstream.video.live`.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from catstream.errors import VideoError, without_password
from catstream.settings import RunSettings
from catstream.video.frames import RATE, Frame, Source, UprightConverter, ffmpeg_reason, video_stream

if TYPE_CHECKING:
    from av import Packet, VideoFrame

#: All frames of a source.
ALL_FRAMES = slice(None)

#: Suffixes of the files in a folder that are read as images, and as videos. A file that is named may have any.
_IMAGES = "avif bmp jp2 jpe jpeg jpg pbm pgm png pnm ppm tif tiff webp"
_VIDEOS = (
    "264 265 3g2 3gp asf avi divx dv f4v flv gif h264 h265 hevc m2t m2ts m2v m4v mjpeg mjpg mkv mov mp4 mpe mpeg mpg "
    "mts mxf nut ogm ogv qt rm rmvb ts vob webm wmv wtv y4m"
)
IMAGES, VIDEOS = ({f".{suffix}" for suffix in suffixes.split()} for suffixes in (_IMAGES, _VIDEOS))
_FOLDERS = ("img", "imgs", "color", "rgb")
_EXPECTED = "give a video file, a folder of images, a pattern like images/%05d.png, or rtsp:// and http:// for a stream"
_LIVE_ADDRESS = re.compile(r"\d+|/dev/video\d+|demo:.*|(?!(?i:file):)[a-zA-Z][\w+.-]+://.+", re.DOTALL)

#: After so many errors of the container without a packet between them, a file is treated as ended.
_MAX_FAILURES = 3

#: The frames of a larger file (in bytes) are estimated from its duration instead of being counted.
_MAX_COUNTED_BYTES = 1 << 30


class _FileSource(Source):
    """The frames of a `part` of a file or of images, from number `start` on. The constructor decodes the first one."""

    def __init__(self, name: str, reader: _Images | _Video, part: slice, start: int) -> None:
        self._reader, self._part = reader, part
        wanted = range(sys.maxsize)[part]
        self._frames = reader.frames(wanted, start)
        self._first: Frame | None = next(self._frames, None)
        if self._first is None:
            raise VideoError(
                f"{name} has {reader.count() or 'no'} frames, numbered from 0, and none from frame "
                f"{wanted[start:].start} on: give an earlier first frame, or another source"
            )
        height, width = self._first.image.shape[:2]
        super().__init__(name, reader.rate / (part.step or 1), (width, height))
        self.pixel_aspect = reader.pixel_aspect

    @cached_property
    def frames(self) -> int | None:
        total = self._reader.count()
        return len(range(total)[self._part]) if total else None

    @property
    def counters(self) -> dict[str, float]:
        """`damaged`: number of packets, which is that of their frames, that were left out."""
        return {"damaged": self._reader.damaged} if self._reader.damaged else {}

    def __next__(self) -> Frame:
        if self._first is not None:
            frame, self._first = self._first, None
            return frame
        return next(self._frames)

    def close(self) -> None:
        self._first = None
        self._frames.close()


def is_live(text: str | Path) -> bool:
    """Return whether a text names a live source. A number names a camera; a folder named 0 is ./0.

    >>> [is_live(text) for text in ("0", "/dev/video2", "rtsp://10.0.0.7/stream", "demo:1", "./0", "walk.mp4")]
    [True, True, True, True, False, False]
    """
    return _LIVE_ADDRESS.fullmatch(str(text)) is not None


def open_source(
    text: str | Path,
    start: int = 0,
    *,
    part: slice = ALL_FRAMES,
    since: float | None = None,
    idle: Callable[[], bool] | None = None,
    settings: RunSettings | None = None,
    **single: Any,
) -> Source:
    """Open the source that `text` names; the docstring of the module lists the kinds.

    start     number of the first frame to return, counted within the part. The frames before it in a file are decoded
              and dropped; a live source numbers its first frame `start`
    part      the frames of a file or folder that are read, for example `slice(100, 200, 2)` for 100, 102 ... 198
    since     zero of the time stamps of a live source, as `time.monotonic` gives it; None for its first frame
    idle      is called ten times a second while a live source gives no frame; if it returns True, iteration ends. With
              it, opening a live source never fails: iteration waits for the first frame for any length of time, and the
              size is known with that frame
    settings  the settings of a run, of which `image_rate`, `skip_damaged` and `resize` are used
    single    single ones of them by name, in the place of those in `settings`

    VideoError if the source does not exist or cannot be read; from the iterator at what cannot be decoded, after the
    frames before it.
    """
    settings = replace(settings or RunSettings(), **single)
    if min(part.start or 0, part.stop or 0) < 0 or (part.step is not None and part.step < 1):
        raise VideoError(f"frames count from 0 and the stride from 1, got {part.start}, {part.stop}, {part.step}")
    if part.stop is not None and part.stop <= (part.start or 0):
        raise VideoError(f"no frame is from {part.start or 0} on and before {part.stop}: give an end after the start")
    if is_live(text):
        if part != ALL_FRAMES:
            raise VideoError("a live source gives only its newest frame: leave out start, end and stride")
        # Imported here because files do not need threads, or the rendering of the demo.
        from catstream.video.live import LiveSource
        from catstream.video.live_demo import PREFIX, LiveDemo

        if str(text).startswith(PREFIX):
            return LiveDemo(str(text), start, settings.image_rate, since=since, idle=idle)
        return LiveSource(str(text), start, settings, since=since, idle=idle)
    shown = without_password(str(text))
    if re.match(r"\w+:/[^/]", str(text)) and not Path(text).exists():
        raise VideoError(f"the address of {shown!r} has one slash: write two of them after its protocol")
    if str(text) == "-":
        raise VideoError(
            "standard input is not a source, because a restarted process cannot read it again: "
            "write the video to a file, or serve it as a stream"
        )
    try:
        name, reader = _opened(Path(source_text(text)), settings)
    except OSError as error:
        raise VideoError(f"cannot open {shown!r} ({error.strerror}): {_EXPECTED}") from None
    return _FileSource(name, reader, part, start)


def _opened(path: Path, settings: RunSettings) -> tuple[str, _Images | _Video]:
    """Open a file, a folder or a pattern; return its name for results, and what reads it."""
    if path.is_dir():
        name = path.resolve().name
        for folder in (*(path / inner for inner in _FOLDERS), path):
            if folder.is_dir() and _visible(folder, IMAGES):
                return name, _Images(image_files(folder), settings)
        videos = _visible(path, VIDEOS)
        if len(videos) == 1:
            return videos[0].stem, _Video(videos[0], settings)
        content = f"{len(videos)} videos" if videos else "neither images nor a video"
        raise VideoError(f"the folder {str(path)!r} holds {content}: {_EXPECTED}")
    if path.is_file():
        return path.stem, _Video(path, settings)
    if re.search(r"%0?\d*d|[*?\[]", path.name):
        return path.parent.resolve().name, _Images(image_files(path), settings)
    if path.exists():
        raise VideoError(
            f"{str(path)!r} is a pipe or a device, and a restarted process cannot read its frames again: "
            "write the video to a file, or serve it as a stream"
        )
    raise VideoError(f"there is no video or folder {without_password(str(path))!r}: {_EXPECTED}")


def source_text(source: object) -> str:
    """The text of a source that a program has given; of a file:// address of this machine its path.

    >>> source_text("file:///videos/a%20walk.mp4"), source_text(Path("walk.mp4")), source_text(0)
    ('/videos/a walk.mp4', 'walk.mp4', '0')
    """
    if not isinstance(source, (str, int, os.PathLike)):
        raise VideoError(
            f"a source is a path, an address or the number of a camera, got {type(source).__name__}: "
            "for frames in memory, call catstream.Tracker.update with each of them"
        )
    text = str(source)
    if not text.startswith("file://"):
        return text
    address = urlsplit(text)
    if address.netloc not in ("", "localhost"):
        raise VideoError(f"{text!r} names a file on another machine: copy it here, or give file:///PATH")
    return unquote(address.path)


def image_files(path: Path) -> list[Path]:
    """Return the image files in a folder, or those that match a pattern (%05d, *), in natural order, at least one."""
    if path.is_dir():
        files = _visible(path, IMAGES)
    elif number := re.search(r"%0?(\d*)d", path.name):
        digits = rf"\d{{{number[1]},}}" if number[1] else r"\d+"
        name = re.escape(path.name[: number.start()]) + digits + re.escape(path.name[number.end() :])
        files = [file for file in path.parent.glob("*") if re.fullmatch(name, file.name)]
    else:
        files = list(path.parent.glob(path.name))
    files = [file for file in files if not file.name.startswith(".")]
    if not files:
        kinds = ", ".join(sorted(suffix[1:] for suffix in IMAGES))
        raise VideoError(f"there are no images at {str(path)!r}: {_EXPECTED} (images are {kinds})")
    return sorted(files, key=natural_order)


def _visible(folder: Path, kinds: set[str]) -> list[Path]:
    """Return the files in a folder that have one of these suffixes and are not hidden."""
    return [file for file in folder.iterdir() if file.suffix.lower() in kinds and not file.name.startswith(".")]


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Sort key by which 10 comes after 2."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


class _Images:
    """Image files that are read as frames."""

    damaged, pixel_aspect = 0, Fraction(1)

    def __init__(self, files: list[Path], settings: RunSettings) -> None:
        self.files, self.settings, self.rate = files, settings, settings.image_rate

    def count(self) -> int:
        return len(self.files)

    def frames(self, wanted: range, start: int) -> Generator[Frame]:
        """Yield the frames with these numbers, from the one at index `start` on."""
        numbers, resize = range(len(self.files))[wanted.start : wanted.stop : wanted.step], self.settings.resize
        # The size is that of the first image of the run, if it is resumed too.
        shape = self._read(numbers[0]).shape if resize and start and numbers else None
        for index, number in enumerate(numbers[start:], start):
            image = self._read(number)
            shape = shape or image.shape
            yield Frame(index, number / self.rate, _of_one_size(image, shape, resize, self.files[number], number))

    def _read(self, number: int) -> np.ndarray:
        image = read_image(self.files[number])
        if image is None:
            name = str(self.files[number])
            raise VideoError(f"cannot read the image {name!r} (frame {number}): replace or remove it")
        return image


def _of_one_size(image: np.ndarray, shape: tuple[int, ...], resize: bool, path: Path, number: int) -> np.ndarray:
    """Return an image in the size of the first one. Raises VideoError if it has another, unless it is to be scaled."""
    if image.shape == shape:
        return image
    if resize:
        return cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    raise VideoError(
        f"all images of a source need one size: {str(path)!r} (frame {number}) is {image.shape[1]}x{image.shape[0]}, "
        f"the first {shape[1]}x{shape[0]}: --resize (run.resize=true) scales it to that"
    )


def read_image(path: Path) -> np.ndarray | None:
    """Return an image as uint8 (h, w, 3), or None if it cannot be read; OpenCV's warnings are suppressed."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        # Not by cv2.imread, which crashes at a name that is not UTF-8, and decodes the half of a JPEG.
        data = path.read_bytes()
        return None if _is_cut_off(data) else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error):  # also if it is empty, or states more pixels than OpenCV reads
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)


def _is_cut_off(data: bytes) -> bool:
    """Whether this is a JPEG in which no end of the image (FF D9) follows its first scan (FF DA)."""
    place = 2
    while data[place : place + 1] == b"\xff" and data[place + 1 : place + 2] != b"\xda":
        place += 2 + int.from_bytes(data[place + 2 : place + 4])
    return data.startswith(b"\xff\xd8\xff") and data[place : place + 1] == b"\xff" and b"\xff\xd9" not in data[place:]


def prepare() -> None:
    """Import what reading a video needs."""
    import av.video.reformatter  # noqa: F401


class _Video:
    """A video file that is read once. `damaged` is the number of packets that were left out."""

    def __init__(self, path: Path, settings: RunSettings) -> None:
        import av  # imported here because it takes 0.1 s and folders do not need it

        self.path, self.settings, self.damaged = path, settings, 0
        try:
            # Text in the file, as its title, may be in any encoding.
            self.container = av.open(str(path.absolute()), metadata_errors="replace")
        except (av.FFmpegError, OSError) as error:
            raise VideoError(f"{str(path)!r} is not a video that can be read ({error.strerror}): {_EXPECTED}") from None
        self.stream = video_stream(self.container)
        # FFmpeg opens any text file as a video of its text (format "tty").
        if self.stream is None or self.container.format.name == "tty":
            self.container.close()
            raise VideoError(f"there is no video in {str(path)!r}: {_EXPECTED}")
        self.stream.thread_type = "NONE"  # the processes of the pipeline already use the cores
        # A stream without a container, as raw H.264, has no time stamps, but may state its rate. An AVI has the times
        # of decoding only, and FFmpeg gives them to pictures that are in another order.
        has_times = not av.format.Flags(self.container.format.flags) & av.format.Flags.no_timestamps
        self._is_avi = self.container.format.name == "avi"
        self.pixel_aspect = self.stream.sample_aspect_ratio or Fraction(1)
        self._clock = ("dts" if self._is_avi else "pts") if has_times else ""
        self.rate = float((has_times and self.stream.average_rate) or self.stream.guessed_rate or RATE)

    def count(self) -> int | None:
        """Return the number of frames: the stated one, or else that of the packets."""
        # The header of an AVI counts packets without data, which repeat the frame before, too.
        if self.stream.frames and not self._is_avi:
            return int(self.stream.frames)
        video = _Video(self.path, self.settings)
        with video.container:
            if self.path.stat().st_size > _MAX_COUNTED_BYTES:
                return round((video.container.duration or 0) / 1e6 * self.rate) or None
            return sum(1 for packet in video._packets() if not isinstance(packet, str)) - 1 or None

    def frames(self, wanted: range, start: int) -> Generator[Frame]:
        """Yield the frames with these numbers, from the one at index `start` on."""
        zero, time, shape, upright, rest = None, -1.0, None, UprightConverter(), wanted[start:]
        with self.container:
            for number, frame in enumerate(self._decoded()):
                ticks = getattr(frame, self._clock) if self._clock else None
                zero = ticks if zero is None else zero
                stated = number / self.rate if ticks is None else float((ticks - (zero or 0)) * self.stream.time_base)
                # Where files were joined, the time stamps begin again, but time goes on.
                time = stated if stated > time else time + 1 / self.rate
                if number in rest or (number in wanted and shape is None):
                    image = upright(frame)
                    shape = shape or image.shape
                    image = _of_one_size(image, shape, self.settings.resize, self.path, number)
                    if number in rest:
                        yield Frame(wanted.index(number), time, image)
                if number + 1 >= wanted.stop:  # damage after the part must not be an error
                    return

    def _decoded(self) -> Iterator[VideoFrame]:
        """Yield what FFmpeg decodes. At an error, raise VideoError, or continue at the next key frame."""
        import av

        decoder, skip, good = self.stream.codec_context, self.settings.skip_damaged, 0
        waits_for_key = is_spoilt = False  # of the packets after an error, and of the frames after a damaged one
        for packet in self._packets():
            if waits_for_key and isinstance(packet, av.Packet) and not packet.is_keyframe:
                self.damaged += 1
                continue
            frames: list[VideoFrame] = []
            problem = packet if isinstance(packet, str) else ""
            try:
                frames = [] if problem else decoder.decode(packet)
            except av.FFmpegError as error:
                problem = ffmpeg_reason(error)
            waits_for_key = bool(problem)
            if problem and skip:
                self.damaged += 1
                with contextlib.suppress(av.FFmpegError):  # the decoder still holds frames before it
                    frames = decoder.decode(None)
                decoder.flush_buffers()
            for frame in frames:
                is_spoilt = frame.is_corrupt or (is_spoilt and not frame.key_frame)
                if is_spoilt and not skip:
                    problem = "its picture is damaged"
                    break
                if is_spoilt:
                    self.damaged += 1
                else:
                    yield frame
                    good += 1
            if problem and not skip:
                raise VideoError(
                    f"{str(self.path)!r} is damaged at frame {good} ({problem}): "
                    "--skip-damaged (run.skip_damaged=true) continues at the next key frame"
                )

    def _packets(self) -> Iterator[Packet[Any] | str | None]:
        """Yield the packets that hold data, the reason of each error of the container, and None at the end."""
        import av

        packets, failures = self.container.demux(self.stream), 0
        while failures < _MAX_FAILURES:
            try:
                packet = next(packets, None)
            except av.FFmpegError as error:
                packets = self.container.demux(self.stream)  # continues at the current position
                if not isinstance(error, av.BlockingIOError):  # that asks to try again
                    failures += 1
                    yield ffmpeg_reason(error)
                continue
            if packet is None:
                break
            if packet.size:
                failures = 0
                # MPEG-TS counts again from 0 where files were joined. This is no damage; what the decoder lacks is.
                packet.is_corrupt = False
                yield packet
        yield None

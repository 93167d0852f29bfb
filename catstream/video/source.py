"""Sources: where frames come from, by one text that a person types.

    with open_source("walk.mp4") as source:
        for frame in source:
            print(frame.number, frame.time, frame.image.shape)

What the text may be:

    a video file        all that FFmpeg reads; every frame once, in order
    a folder            its images in natural order (2.png before 10.png), or those of its `img`, `color` or `rgb`
                        folder, or its one video: so the sequence folders of the benchmarks open as they are
    a pattern           images/%05d.png or images/*.png
    a camera            0 or /dev/video0
    a stream            rtsp://HOST/PATH, or http://HOST/PATH for MJPEG
    a file:// address   file:///home/me/walk.mp4, as other programs copy it

Files and images are read to their last frame and none is skipped. If a file is
damaged, its good frames come first and then a `VideoError`; with
`run.skip_damaged` it is read on after the damaged place. Cameras and streams are
live: see `catstream.video.live`.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from catstream.errors import VideoError
from catstream.video.frames import RATE, Frame, Source, UprightConverter, ffmpeg_reason

__all__ = ["ALL_FRAMES", "image_files", "is_live", "natural_order", "open_source", "without_scheme"]

#: All frames of a source.
ALL_FRAMES = slice(None)

_IMAGES = {".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"}
_VIDEOS = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ts", ".webm", ".wmv"}
_FOLDERS = ("img", "imgs", "color", "rgb")
_EXPECTED = "give a video file, a folder of images, a pattern like images/%05d.png, or rtsp:// and http:// for a stream"
_LIVE_ADDRESS = re.compile(r"\d+|/dev/video\d+|(rtsps?|https?)://.+")

#: A video that ends this much before its container says was cut off: rounding and audio explain less.
_CUT_OFF_SECONDS = 0.5


#: Reading a container that fails so often in a row, without a packet between, has come to its end.
_MAX_FAILURES = 3

#: Bytes between two packets of a Matroska file that belong to none: the heads of clusters and blocks have far fewer.
_MAX_BYTES_BETWEEN_PACKETS = 4096

#: A file larger than this, in bytes, is not read through to count its frames.
_MAX_COUNTED_BYTES = 1 << 30


class _FileSource(Source):
    """A source whose frames are all read. Its constructor decodes the first one.

    Parameters
    ----------
    stream : the frames of `part`, from number `start` of them on
    total : returns how many frames the whole source has, None if that cannot be known
    rate : frames per second of the whole source
    damage : of the file that `stream` reads

    Raises
    ------
    VideoError
        From the constructor if there is no first frame, from the iterator if the source is damaged, after its good
        frames.
    """

    def __init__(
        self,
        name: str,
        stream: Iterator[Frame],
        total: Callable[[], int | None],
        part: slice,
        start: int,
        rate: float,
        damage: _Damage | None = None,
    ) -> None:
        self._stream, self._total, self._part, self._damage = stream, total, part, damage
        self._first: Frame | None = next(stream, None)
        if self._first is None:
            wanted = range(sys.maxsize)[part][start:]
            end = " on" if part.stop is None else f" to before {wanted.stop}"
            raise VideoError(
                f"{name} has {total() or 'no'} frames, numbered from 0, and none to follow from frame {wanted.start}"
                f"{end}: give an earlier first frame, or another source"
            )
        height, width = self._first.image.shape[:2]
        super().__init__(name, rate / (part.step or 1), (width, height))

    @cached_property
    def frames(self) -> int | None:
        total = self._total()
        return len(range(total)[self._part]) if total else None

    @property
    def counters(self) -> dict[str, float]:
        """`damaged`: how many frames could not be decoded and were left out."""
        return {"damaged": self._damage.frames} if self._damage is not None and self._damage.frames else {}

    def __next__(self) -> Frame:
        if self._first is not None:
            frame, self._first = self._first, None
            return frame
        return next(self._stream)

    def close(self) -> None:
        self._first = None
        close: Callable[[], None] | None = getattr(self._stream, "close", None)
        if close is not None:
            close()


def is_live(text: str | Path) -> bool:
    """Whether this names a camera or a stream. A number is a camera: a folder of that name is ./0.

    >>> [is_live(text) for text in ("0", "/dev/video2", "rtsp://10.0.0.7/stream", "./0", "walk.mp4")]
    [True, True, True, False, False]
    """
    return _LIVE_ADDRESS.fullmatch(str(text)) is not None


def open_source(
    text: str | Path,
    start: int = 0,
    *,
    part: slice = ALL_FRAMES,
    since: float | None = None,
    idle: Callable[[], bool] | None = None,
    image_rate: float = RATE,
    skip_damaged: bool = False,
) -> Source:
    """Open what `text` names, see the module.

    Parameters
    ----------
    text : what and where
    start : number of the first frame wanted, of those in the part. In a file those before it are decoded, never
        guessed at; a live source counts from there
    part : which frames of a file or folder there are for whoever reads, `slice(100, 200, 2)` for 100, 102 ... 198
    since : moment of `time.monotonic` that the times of a live source count from, its first frame where None
    idle : called ten times a second while a live source gives no frame; where it returns True, iterating ends.
        Who gives one waits for the first frame too, however long it takes: opening then never fails, and the
        size is known with the first frame
    image_rate : frames per second of images, which have no clock
    skip_damaged : read a video file on after a damaged place. The frames that cannot be decoded are left out, the
        next good one takes the next number, and its time is the true one

    Raises
    ------
    VideoError
        If there is nothing, or nothing readable; says what was expected.
    """
    if min(part.start or 0, part.stop or 0) < 0 or (part.step is not None and part.step < 1):
        raise VideoError(f"frames count from 0 and the stride from 1, got {part.start}, {part.stop}, {part.step}")
    if is_live(text):
        if part != ALL_FRAMES:
            raise VideoError("of a live source only the newest frame can be had: leave start, end and stride away")
        from catstream.video.live import LiveSource  # here, as files do without its threads

        return LiveSource(str(text), start, since=since, idle=idle)
    if str(text) == "-":
        raise VideoError(
            "a pipe cannot be read again after a process was restarted, so standard input is no source: "
            "write the video to a file, or serve it as a stream that can be opened again"
        )
    path = Path(without_scheme(str(text)))
    images = partial(_open_images, part=part, start=start, rate=image_rate)
    video = partial(_open_video, part=part, start=start, skip_damaged=skip_damaged)
    try:
        if path.is_dir():
            return _open_folder(path, images, video)
        if path.is_file():
            return video(path)
        if re.search(r"%0?\d*d|[*?\[]", path.name):
            return images(path.parent.resolve().name, image_files(path))
    except OSError as error:
        raise VideoError(f"cannot open {str(text)!r} ({error.strerror}): {_EXPECTED}") from None
    raise VideoError(f"there is no video or folder {str(text)!r}: {_EXPECTED}")


def without_scheme(text: str) -> str:
    """The path that a file:// address names; any other text as it is.

    Raises
    ------
    VideoError
        For a file of another machine.

    >>> without_scheme("file:///videos/a%20walk.mp4"), without_scheme("./0")
    ('/videos/a walk.mp4', './0')
    """
    if not text.startswith("file://"):
        return text
    address = urlsplit(text)
    if address.netloc not in ("", "localhost"):
        raise VideoError(f"{text!r} names a file of another machine: copy it here, or give file:///PATH")
    return unquote(address.path)


def image_files(path: Path) -> list[Path]:
    """Images in a folder or of a pattern (%05d, *), in natural order.

    Raises
    ------
    VideoError
        Where there is none.
    """
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in _IMAGES]
    elif number := re.search(r"%0?(\d*)d", path.name):
        digits = rf"\d{{{number[1]},}}" if number[1] else r"\d+"
        name = re.escape(path.name[: number.start()]) + digits + re.escape(path.name[number.end() :])
        files = [file for file in path.parent.glob("*") if re.fullmatch(name, file.name)]
    else:
        files = list(path.parent.glob(path.name))
    files = [file for file in files if not file.name.startswith(".")]
    if not files:
        kinds = ", ".join(sorted(suffix[1:] for suffix in _IMAGES))
        raise VideoError(f"there are no images at {str(path)!r}: {_EXPECTED} (images are {kinds})")
    return sorted(files, key=natural_order)


def natural_order(path: Path) -> list[Any]:
    """Key of an order in which 10 comes after 2."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _open_folder(path: Path, images: Callable[..., Source], video: Callable[..., Source]) -> Source:
    name = path.resolve().name
    for folder in (*(path / inner for inner in _FOLDERS), path):
        if folder.is_dir() and any(file.suffix.lower() in _IMAGES for file in folder.iterdir()):
            return images(name, image_files(folder))
    videos = sorted(file for file in path.iterdir() if file.suffix.lower() in _VIDEOS)
    if len(videos) == 1:
        return video(videos[0])
    content = f"{len(videos)} videos" if videos else "neither images nor a video"
    raise VideoError(f"the folder {str(path)!r} holds {content}: {_EXPECTED}")


def _open_images(name: str, files: list[Path], *, part: slice, start: int, rate: float) -> Source:
    frames = _read_images(files, range(len(files))[part], start, rate)
    return _FileSource(name, frames, lambda: len(files), part, start, rate)


def _read_images(files: list[Path], wanted: range, start: int, rate: float) -> Iterator[Frame]:
    shape: tuple[int, ...] | None = None
    for count, number in enumerate(wanted[start:], start):
        image = _read_image(files[number])
        if image is None:
            raise VideoError(f"cannot read the image {str(files[number])!r} (frame {number}): replace or remove it")
        if shape is not None and image.shape != shape:
            raise VideoError(
                f"all images of a source need one size: {str(files[number])!r} (frame {number}) is "
                f"{image.shape[1]}x{image.shape[0]}, those before it {shape[1]}x{shape[0]}"
            )
        shape = image.shape
        yield Frame(count, number / rate, image)


def _read_image(path: Path) -> np.ndarray | None:
    """An image as uint8 (h, w, 3), None if it cannot be read. OpenCV's own warnings are not printed."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imread(str(path), cv2.IMREAD_COLOR)
    finally:
        cv2.utils.logging.setLogLevel(level)


def _open_video(path: Path, *, part: slice, start: int, skip_damaged: bool) -> Source:
    import av  # here, as it costs 0.1 s and folders do without

    try:
        container = av.open(str(path.absolute()))
    except (av.FFmpegError, OSError) as error:
        raise VideoError(f"{str(path)!r} is not a video that can be read ({error.strerror}): {_EXPECTED}") from None
    # FFmpeg renders text files as video; nobody means that.
    streams = container.streams.video
    if not streams or streams[0].codec_context is None or container.format.name == "tty":
        container.close()
        raise VideoError(f"there is no video in {str(path)!r}: {_EXPECTED}")
    stream = streams[0]
    rate = float(stream.average_rate or stream.guessed_rate or RATE)
    stated, damage = stream.frames, _Damage(path, skip_damaged)
    images = _read_video(path, container, rate, range(sys.maxsize)[part], start, damage)
    source = _FileSource(path.stem, images, lambda: stated or _count_frames(path, rate), part, start, rate, damage)
    source.sound = path
    return source


def _count_frames(path: Path, rate: float) -> int | None:
    """Number of frames of a video whose container does not say it: its packets, which need not be decoded."""
    import av

    with av.open(str(path.absolute())) as container:
        stream = container.streams.video[0]
        if path.stat().st_size > _MAX_COUNTED_BYTES:
            return round(_stated_duration(container, stream) * rate) or None
        count = 0
        with contextlib.suppress(av.FFmpegError):  # reading the frames says what is damaged
            count = sum(1 for packet in container.demux(stream) if packet.size)
        return count or None


def _read_video(path: Path, container: Any, rate: float, wanted: range, start: int, damage: _Damage) -> Iterator[Frame]:
    stream = container.streams.video[0]
    stream.thread_type = "NONE"  # the processes are the parallelism
    number, time, zero, shape, upright = 0, 0.0, None, None, UprightConverter()
    with container:
        for frame in _good_frames(container, stream, rate, damage):
            zero = frame.pts if zero is None else zero
            time = number / rate if frame.pts is None else float((frame.pts - zero) * stream.time_base)
            if number in wanted[start:]:
                image = upright(frame)
                if shape is not None and image.shape != shape:
                    raise VideoError(
                        f"{str(path)!r} changes from {shape[1]}x{shape[0]} to {image.shape[1]}x{image.shape[0]} "
                        f"pixels at frame {number}: split it there"
                    )
                shape = image.shape
                yield Frame(wanted.index(number), time, image)
            number += 1
            if number >= wanted.stop:  # what comes after the part may be damaged
                return


class _Damage:
    """Decides what a damaged place in a video file means: reading ends there, or goes on at the next key frame.

    frames  how many were left out there, as the time stamps tell
    """

    def __init__(self, path: Path, skip: bool) -> None:
        self._path, self._skip = path, skip
        self.frames = 0

    def report(self, problem: str, good: int) -> None:
        """Take note of a damaged place after so many good frames.

        Raises
        ------
        VideoError
            Unless damaged places are skipped.
        """
        if not self._skip:
            raise VideoError(
                f"{str(self._path)!r} breaks at frame {good} ({problem}): the frames before are good; "
                "--skip-damaged (skip_damaged=True) goes on after the damaged place"
            )


def _good_frames(container: Any, stream: Any, rate: float, damage: _Damage) -> Iterator[Any]:
    """Decoded frames that are whole, in order; `damage` is told of the places between them that are not."""
    import av

    count, last, since_damage, waits_for_key = 0, None, False, False
    for packet, problem in _packets(container, stream, rate):
        if waits_for_key and packet is not None and packet.size and not packet.is_keyframe:
            continue
        waits_for_key = False
        frames: list[Any] = []
        if not problem:
            try:
                frames = stream.codec_context.decode(packet)
            except av.FFmpegError as error:
                problem = ffmpeg_reason(error)
        if problem:  # the good frames that wait in the decoder for their turn
            with contextlib.suppress(av.FFmpegError):
                frames = stream.codec_context.decode(None)
        for frame in frames:
            gap = 1.0
            if last is not None and frame.pts is not None:
                gap = float((frame.pts - last) * stream.time_base) * rate
            if frame.is_corrupt or (problem and gap > 1.5):
                problem = problem or "its picture is damaged"
                break
            if since_damage:
                damage.frames += max(0, round(gap) - 1)
            last, since_damage = frame.pts, False
            yield frame
            count += 1
        if problem:
            damage.report(problem, count)
            since_damage = waits_for_key = True
            stream.codec_context.flush_buffers()


def _packets(container: Any, stream: Any, rate: float) -> Iterator[tuple[Any, str]]:
    """Packets, the last an empty one, each with what is wrong at its place: the empty text for nothing."""
    import av

    end, place, failures, stated = 0.0, 0, 0, _stated_duration(container, stream)
    matroska = "matroska" in container.format.name
    packets = container.demux()
    while True:
        try:
            packet = next(packets)
        except av.FFmpegError as error:
            failures += 1
            yield None, ffmpeg_reason(error)
            if failures == _MAX_FAILURES:
                return
            packets = container.demux()  # it reads on where it is
            continue
        failures = 0
        # FFmpeg passes over a damaged place in a Matroska file without a word.
        missing = matroska and 0 < place < (packet.pos or 0) - _MAX_BYTES_BETWEEN_PACKETS
        place = max(place, (packet.pos or 0) + packet.size)
        if packet.stream is not stream:
            continue
        if packet.dts is None and not packet.size:
            short = stated - end > max(_CUT_OFF_SECONDS, 2 / rate)
            yield packet, f"it says it lasts {stated:.1f} s, and ends at {end:.1f} s" if short else ""
            return
        if packet.pts is not None:
            end = max(end, float((packet.pts + (packet.duration or 0) - (stream.start_time or 0)) * stream.time_base))
        yield packet, "data is missing" if packet.is_corrupt or missing else ""


def _stated_duration(container: Any, stream: Any) -> float:
    """How long the video says it is, 0 where it does not say."""
    if stream.duration:
        return float(stream.duration * stream.time_base)
    if clock := re.fullmatch(r"(\d+):(\d+):([\d.]+)", stream.metadata.get("DURATION", "")):
        return int(clock[1]) * 3600 + int(clock[2]) * 60 + float(clock[3])
    # Without a duration of its own, only where no sound can outlast the picture.
    return (container.duration or 0) / 1e6 if len(container.streams) == 1 else 0.0

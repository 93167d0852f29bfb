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
    a stream            rtsp://HOST/PATH, or http://HOST/PATH for MJPEG
    a live demo         demo:1; it needs no camera, see `catstream.video.live_demo`
    a file:// address   file:///home/me/walk.mp4

Files and images are read to the last frame, and no frame is skipped. If a file
is damaged, the frames before the damage are returned and then `VideoError` is
raised; with `skip_damaged`, reading continues after the damage. The others
are live: see `catstream.video.live`.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Callable, Generator, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from catstream.errors import VideoError
from catstream.video.frames import RATE, Frame, Source, UprightConverter, ffmpeg_reason, time_base, video_stream

if TYPE_CHECKING:
    from av import Packet, VideoFrame, VideoStream
    from av.container import InputContainer
    from av.stream import Stream

#: All frames of a source.
ALL_FRAMES = slice(None)

#: Suffixes of the files that are read as images, and as videos.
IMAGES = {".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp"}
VIDEOS = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ts", ".webm", ".wmv"}
_FOLDERS = ("img", "imgs", "color", "rgb")
_EXPECTED = "give a video file, a folder of images, a pattern like images/%05d.png, or rtsp:// and http:// for a stream"
_LIVE_ADDRESS = re.compile(r"\d+|/dev/video\d+|(rtsps?|https?)://.+|demo:.*")

#: A video that ends this many seconds before its stated duration was cut off. Rounding and audio cause less.
_CUT_OFF_SECONDS = 0.5

#: After this many consecutive read errors without a packet, the container is treated as ended.
_MAX_FAILURES = 3

#: If more bytes than this lie between two packets of a Matroska file, data is damaged. Cluster and block headers are
#: far smaller.
_MAX_BYTES_BETWEEN_PACKETS = 4096

#: The frames of a larger file (in bytes) are estimated from its duration instead of being counted.
_MAX_COUNTED_BYTES = 1 << 30


class _FileSource(Source):
    """A video file or a set of images. No frame is skipped; the constructor decodes the first frame.

    Parameters
    ----------
    stream : the frames of `part`, starting with number `start` within the part
    total : function that returns the number of frames of the whole source, or None if it is unknown
    rate : frames per second of the whole source
    damage : counter of the damaged frames in the file that `stream` reads

    Raises
    ------
    VideoError
        From the constructor if there is no first frame; from the iterator at the first damage, after the frames before
        it.
    """

    def __init__(
        self,
        name: str,
        stream: Generator[Frame],
        total: Callable[[], int | None],
        part: slice,
        start: int,
        rate: float,
        damage: _Damage | None = None,
    ) -> None:
        self._stream, self._total, self._part, self._damage = stream, total, part, damage
        self._first: Frame | None = next(stream, None)
        if self._first is None:
            number = range(sys.maxsize)[part][start:].start
            raise VideoError(
                f"{name} has {total() or 'no'} frames, numbered from 0, and none from frame {number} on: "
                "give an earlier first frame, or another source"
            )
        height, width = self._first.image.shape[:2]
        super().__init__(name, rate / (part.step or 1), (width, height))

    @cached_property
    def frames(self) -> int | None:
        total = self._total()
        return len(range(total)[self._part]) if total else None

    @property
    def counters(self) -> dict[str, float]:
        """`damaged`: number of frames that could not be decoded and were left out."""
        return {"damaged": self._damage.frames} if self._damage is not None and self._damage.frames else {}

    def __next__(self) -> Frame:
        if self._first is not None:
            frame, self._first = self._first, None
            return frame
        return next(self._stream)

    def close(self) -> None:
        self._first = None
        self._stream.close()


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
    image_rate: float = RATE,
    skip_damaged: bool = False,
    resize: bool = False,
) -> Source:
    """Open the source that `text` names; the docstring of the module lists the kinds.

    Parameters
    ----------
    text : name of the source
    start : number of the first frame to return, counted within the part. The frames before it in a file are decoded
        and dropped; a live source numbers its first frame `start`
    part : the frames of a file or folder that are read, for example `slice(100, 200, 2)` for 100, 102 ... 198
    since : zero of the time stamps of a live source, as `time.monotonic` gives it; None for its first frame
    idle : function that is called ten times a second while a live source gives no frame; if it returns True, iteration
        ends. With it, opening a live source never fails: iteration waits for the first frame for any length of time,
        and the size is known with that frame
    image_rate : frames per second of a folder of images
    skip_damaged : continue after damage in a video file. The frames that cannot be decoded are left out; the next good
        frame gets the next number and keeps its own time stamp
    resize : scale images that have another size than the first one of `part` to that size

    Raises
    ------
    VideoError
        If the source does not exist or cannot be read.
    """
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

        return (LiveDemo if str(text).startswith(PREFIX) else LiveSource)(str(text), start, since=since, idle=idle)
    if str(text) == "-":
        raise VideoError(
            "standard input is not a source, because a restarted process cannot read it again: "
            "write the video to a file, or serve it as a stream"
        )
    path = Path(source_text(text))
    images = partial(_open_images, part=part, start=start, rate=image_rate, resize=resize)
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
    if path.exists():
        raise VideoError(
            f"{str(text)!r} is a pipe or a device, and a restarted process cannot read its frames again: "
            "write the video to a file, or serve it as a stream"
        )
    raise VideoError(f"there is no video or folder {str(text)!r}: {_EXPECTED}")


def source_text(source: object) -> str:
    """The text of a source that a program has given; of a file:// address its path.

    Raises
    ------
    VideoError
        If it is neither a path, an address nor a number, or if the address names another machine.

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
    """Return the image files in a folder, or those that match a pattern (%05d, *), in natural order.

    Raises
    ------
    VideoError
        If there are no images.
    """
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


def _open_folder(path: Path, images: Callable[..., Source], video: Callable[..., Source]) -> Source:
    name = path.resolve().name
    for folder in (*(path / inner for inner in _FOLDERS), path):
        if folder.is_dir() and _visible(folder, IMAGES):
            return images(name, image_files(folder))
    videos = _visible(path, VIDEOS)
    if len(videos) == 1:
        return video(videos[0])
    content = f"{len(videos)} videos" if videos else "neither images nor a video"
    raise VideoError(f"the folder {str(path)!r} holds {content}: {_EXPECTED}")


def _open_images(name: str, files: list[Path], *, part: slice, start: int, rate: float, resize: bool) -> Source:
    frames = _read_images(files, range(len(files))[part], start, rate, resize)
    return _FileSource(name, frames, lambda: len(files), part, start, rate)


def _read_images(files: list[Path], wanted: range, start: int, rate: float, resize: bool) -> Generator[Frame]:
    def read(number: int) -> np.ndarray:
        image = read_image(files[number])
        if image is None:
            raise VideoError(f"cannot read the image {str(files[number])!r} (frame {number}): replace or remove it")
        return image

    shape = read(wanted[0]).shape if resize and start and wanted else None  # that of the run, if it is resumed
    for count, number in enumerate(wanted[start:], start):
        image = read(number)
        shape = shape or image.shape
        if image.shape != shape:
            if not resize:
                raise VideoError(
                    f"all images of a source need one size: {str(files[number])!r} (frame {number}) is "
                    f"{image.shape[1]}x{image.shape[0]}, the first {shape[1]}x{shape[0]}: "
                    "--resize (run.resize=true) scales it to that"
                )
            image = cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
        yield Frame(count, number / rate, image)


def read_image(path: Path) -> np.ndarray | None:
    """Return an image as uint8 (h, w, 3), or None if it cannot be read; OpenCV's warnings are suppressed."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imread(str(path), cv2.IMREAD_COLOR)
    except cv2.error:  # it states more pixels than OpenCV reads
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)


def prepare() -> None:
    """Import what reading a video needs."""
    import av.video.reformatter  # noqa: F401


def _open_video(path: Path, *, part: slice, start: int, skip_damaged: bool) -> Source:
    import av  # imported here because it takes 0.1 s and folders do not need it

    try:
        container = av.open(str(path.absolute()))
    except (av.FFmpegError, OSError) as error:
        raise VideoError(f"{str(path)!r} is not a video that can be read ({error.strerror}): {_EXPECTED}") from None
    stream = video_stream(container)
    # FFmpeg opens any text file as a video of its text (format "tty").
    if stream is None or stream.codec_context is None or container.format.name == "tty":
        container.close()
        raise VideoError(f"there is no video in {str(path)!r}: {_EXPECTED}")
    rate = float(stream.average_rate or stream.guessed_rate or RATE)
    stated, damage = stream.frames, _Damage(path, skip_damaged)
    images = _read_video(path, container, rate, range(sys.maxsize)[part], start, damage)
    source = _FileSource(path.stem, images, lambda: stated or _count_frames(path, rate), part, start, rate, damage)
    source.sound = path
    return source


def _count_frames(path: Path, rate: float) -> int | None:
    """Count the frames of a video whose container does not state their number, by its packets, without decoding."""
    import av

    with av.open(str(path.absolute())) as container:
        stream = video_stream(container)
        if path.stat().st_size > _MAX_COUNTED_BYTES:
            return round(_stated_duration(container, stream) * rate) or None
        count = 0
        with contextlib.suppress(av.FFmpegError):  # damage is reported later, when the frames are read
            count = sum(1 for packet in container.demux(stream) if packet.size)
        return count or None


def _read_video(
    path: Path, container: InputContainer, rate: float, wanted: range, start: int, damage: _Damage
) -> Generator[Frame]:
    stream = video_stream(container)
    stream.thread_type = "NONE"  # the processes of the pipeline already use the cores
    number, time, zero, shape, upright = 0, 0.0, None, None, UprightConverter()
    with container:
        for frame in _good_frames(container, stream, rate, damage):
            zero = frame.pts if zero is None else zero
            time = number / rate if frame.pts is None else float((frame.pts - (zero or 0)) * time_base(stream))
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
            if number >= wanted.stop:  # damage after the part must not be an error
                return


class _Damage:
    """Counts the frames lost to damage in a video file, or raises at the first damage unless it is to be skipped.

    frames  number of frames that were left out, by the time stamps around the damage
    """

    def __init__(self, path: Path, skip: bool) -> None:
        self._path, self._skip = path, skip
        self.frames = 0

    def report(self, problem: str, good: int) -> None:
        """Report damage after `good` undamaged frames.

        Raises
        ------
        VideoError
            Unless damage is to be skipped.
        """
        if not self._skip:
            raise VideoError(
                f"{str(self._path)!r} is damaged at frame {good} ({problem}): "
                "--skip-damaged (run.skip_damaged=true) continues after the damage"
            )


def _good_frames(container: InputContainer, stream: VideoStream, rate: float, damage: _Damage) -> Iterator[VideoFrame]:
    """Yield the undamaged frames in order, and report each damage between them to `damage`."""
    import av

    count, last, since_damage, waits_for_key = 0, None, False, False
    for packet, problem in _packets(container, stream, rate):
        if waits_for_key and packet is not None and packet.size and not packet.is_keyframe:
            continue
        waits_for_key = False
        frames: list[VideoFrame] = []
        if not problem:
            try:
                frames = stream.codec_context.decode(packet)
            except av.FFmpegError as error:
                problem = ffmpeg_reason(error)
        if problem:  # fetch the good frames that are still in the decoder's reorder buffer
            with contextlib.suppress(av.FFmpegError):
                frames = stream.codec_context.decode(None)
        for frame in frames:
            gap = 1.0
            if last is not None and frame.pts is not None:
                gap = float((frame.pts - last) * time_base(stream)) * rate
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
    if since_damage and last is not None:  # the rest of the file, by its stated duration
        rest = _stated_duration(container, stream) - float((last - (stream.start_time or 0)) * time_base(stream))
        damage.frames += max(0, round(rest * rate) - 1)


def _packets(
    container: InputContainer, stream: VideoStream, rate: float
) -> Iterator[tuple[Packet[Stream] | None, str]]:
    """Yield each packet with a description of the damage before or in it, "" if there is none. The last packet is the
    empty one that flushes the decoder."""
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
            packets = container.demux()  # continues at the current position
            continue
        failures = 0
        # FFmpeg skips damaged parts of a Matroska file without an error.
        missing = matroska and 0 < place < (packet.pos or 0) - _MAX_BYTES_BETWEEN_PACKETS
        place = max(place, (packet.pos or 0) + packet.size)
        if packet.stream is not stream:
            continue
        if packet.dts is None and not packet.size:
            short = stated - end > max(_CUT_OFF_SECONDS, 2 / rate)
            yield packet, f"its stated duration is {stated:.1f} s, it ends at {end:.1f} s" if short else ""
            return
        if packet.pts is not None:
            end = max(end, float((packet.pts + (packet.duration or 0) - (stream.start_time or 0)) * time_base(stream)))
        yield packet, "data is missing" if packet.is_corrupt or missing else ""


def _stated_duration(container: InputContainer, stream: VideoStream) -> float:
    """Return the duration that the container states for the video stream in seconds, 0 if it states none."""
    if stream.duration:
        return float(stream.duration * time_base(stream))
    if clock := re.fullmatch(r"(\d+):(\d+):([\d.]+)", stream.metadata.get("DURATION", "")):
        return int(clock[1]) * 3600 + int(clock[2]) * 60 + float(clock[3])
    # The container's duration is that of its longest stream, so it counts only if the video is the only stream.
    return (container.duration or 0) / 1e6 if len(container.streams) == 1 else 0.0

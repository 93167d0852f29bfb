"""Random access to the images of a video.

A frame is decoded from the last keyframe before it, so neither memory nor disk holds the whole video. Frames are
numbered by their packets alone in containers and codecs where this is reliable. Other files are decoded once for this.
"""

from __future__ import annotations

import sys
import threading
from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, islice
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from catstream.base.arrays import UInt8
from catstream.base.settings import RunSettings
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.video.frames import UprightConverter
from catstream.video.images import of_one_size
from catstream.video.source import ALL_FRAMES, FileSource, Images, counters_of, open_source
from catstream.video.video_file import VideoFile

if TYPE_CHECKING:
    from av import Packet, VideoFrame

#: Called with the number of numbered frames, and the number of all frames or None.
Progress = Callable[[int, int | None], object]

#: Containers and codecs in which each packet holds one frame, and frames are in the order of their time stamps.
_CONTAINERS = ("mov", "matroska")
_CODECS = ("h264", "hevc", "av1", "vp9", "mjpeg", "prores", "dnxhd", "ffv1")
_VERIFIED = 8  #: frames that are decoded to verify this

#: Decoders that can skip frames without references to them.
_SKIPPABLE = ("h264", "mpeg2video", "mpeg4")

_CACHE_BYTES = 32 << 20  #: of decoded frames, in the pixel format of the video
_NO_STAMP = -(1 << 63)
_ATTEMPTS = 5  #: limit of seeks to earlier keyframes, and of packets after each, until a packet is recognised
_COLUMNS = 6  #: length of a `_row`
_INTERVAL = 256  #: packets between two calls of a `Progress`


@dataclass(frozen=True)
class _Index:
    """The frames and the packets of a video file, each in their own order.

    packets  int (frames,), number of the packet of each frame; -1 if the decoder does not state it
    rows     int (packets, 6), see `_row`
    """

    packets: np.ndarray
    rows: np.ndarray

    @cached_property
    def is_unique(self) -> bool:
        """True if each frame has a packet of its own; if not, frames are counted from the first one."""
        return bool((self.packets >= 0).all()) and len(np.unique(self.packets)) == len(self.packets)

    @cached_property
    def numbers(self) -> np.ndarray:
        """The number of the frame of each packet, -1 without one."""
        numbers = np.full(len(self.rows), -1)
        numbers[self.packets] = np.arange(len(self.packets))
        return numbers

    @cached_property
    def starts(self) -> list[tuple[int, int]]:
        """First frame and packet of each part that can be decoded alone, at keyframes after all earlier frames."""
        starts, keys, end = [(0, 0)], np.flatnonzero(self.rows[:, 3]), len(self.rows)
        # Damage is noticed late: near it, a keyframe may depend on earlier pictures.
        damaged = np.r_[0, self.rows[:, 5]][[0, *keys, end, end]]
        for key in keys[damaged[:-3] == damaged[3:]] if self.is_unique else ():
            if (number := self.numbers[key]) > starts[-1][0]:
                starts.append((int(number), int(key)))
        return starts


def _row(packet: Packet[Any], damaged: int = 0) -> tuple[int, ...]:
    """Position of a packet in the file, time stamp of presentation in ticks, size, whether it is a keyframe, whether
    its frame is discarded, and the number of damaged packets before it."""
    position, stamp = (_NO_STAMP if value is None else value for value in (packet.pos, packet.pts))
    return position, stamp, packet.size, packet.is_keyframe, packet.is_discard, damaged


class VideoFrames:
    """Random access to the images of a video, uint8 (h, w, 3) in BGR: frame n is the n-th image of `open_source`.

    Reading forwards decodes each frame once. Reading backwards decodes a group of pictures once for each part that fits
    into the cache. Several threads may read. A pickled copy opens the file anew.

    Parameters
    ----------
    text, part, settings : as of `open_source`, but not a live source

    Attributes
    ----------
    name, rate, size, images, counters : as of a `Source`
    settings : as of the parameters
    times : float64, seconds of the frames that are numbered so far; before `scan`, of the first one
    is_threaded : whether the decoder uses several threads, for a short latency; not in a pickled copy
    is_exact : whether all frames were decoded; if not, an image may raise VideoError, because its file is damaged
    """

    def __init__(self, text: str | Path, part: slice = ALL_FRAMES, settings: RunSettings | None = None) -> None:
        self.settings, self._part = settings or RunSettings(), part
        with open_source(text, part=part, settings=self.settings) as source:
            if not isinstance(source, FileSource):
                raise VideoError(f"{str(text)!r} is a live source: expected a video file, or a folder of images")
            first = next(source)
            self._source = source.reader if isinstance(source.reader, Images) else source.reader.path
        self.name, self.rate, self.size, self.images = source.name, source.rate, source.size, source.images
        self.times, self.counters = np.array([first.time]), source.counters
        self.is_exact = self.is_threaded = False
        self._first: UInt8 = first.image
        self._index: _Index | None = None
        self._lock = threading.RLock()
        self._reader: _Reader | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "is_threaded": False, "_lock": None, "_reader": None, "_first": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=threading.RLock())

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, number: int) -> UInt8:
        """Return an image; VideoError if it cannot be decoded, and is not `is_exact`."""
        width, height = self.size
        with self._lock:
            if isinstance(self._source, Images):
                return self._source.image(range(self._source.count())[self._part][number], (height, width, 3))
            if self._index is None:
                return self._first
            if self._reader is None:
                self._reader = _Reader(self, self._source, self._index)
            return self._reader.image(range(len(self._index.packets))[self._part][number])

    def close(self) -> None:
        """Free the decoder and its cache; the next image opens the file again."""
        with self._lock:
            if self._reader is not None:
                self._reader.close()
            self._reader = None

    def scan(self, progress: Progress = lambda *_: None, *, exact: bool = False) -> None:
        """Number the frames by their packets if this is reliable, otherwise, or if `exact`, by decoding all.

        VideoError if a frame cannot be decoded; the frames before it are numbered.
        """
        try:
            if isinstance(self._source, Images):
                self._scan_images(self._source, progress, exact=exact)
            elif exact or self.settings.skip_damaged or not self._scan_packets(self._source, progress):
                self._decode_all(self._source, progress)
        except VideoError as error:
            raise VideoError(f"{counted(len(self), 'frame')} could be read: {error}") from None

    def _scan_images(self, images: Images, progress: Progress, *, exact: bool) -> None:
        numbers = range(images.count())[self._part]
        times = array("d") if exact else [number / images.rate for number in numbers]
        try:
            for frame in images.frames(range(sys.maxsize)[self._part], 0) if exact else ():
                times.append(frame.time)
                progress(len(times), len(numbers))
        finally:
            self.times, self.is_exact, self.counters = np.array(times), exact, counters_of(images)

    def _scan_packets(self, path: Path, progress: Progress) -> bool:
        """Number the frames by the time stamps of the packets; return False if this is not reliable."""
        video, rows = VideoFile(path, self.settings), array("q")
        containers, codec = video.container.format.name.split(","), video.stream.codec_context.codec.canonical_name
        with video.container:
            if codec not in _CODECS or not set(containers) & set(_CONTAINERS):
                return False
            # Step 1: read all packets, without decoding.
            for number, packet in enumerate(video.packets(), 1):
                if isinstance(packet, str):
                    return False
                if packet is not None:
                    rows.extend(_row(packet))
                    if number % _INTERVAL == 0:
                        progress(number, None)
            _, stamps, _, keys, discarded, _ = np.array(rows).reshape(-1, _COLUMNS).T
            # Step 2: sort the shown frames by time stamp.
            shown, keys = discarded == 0, keys == 1
            ordered = np.flatnonzero(shown)[stamps[shown].argsort(kind="stable")]
            # Step 3: stamps must increase, and each must lie between the keyframes before and after its own.
            limits, group = stamps[keys], keys.cumsum() - 1
            low, high = np.r_[limits[:1], limits[:-1]], np.r_[limits[1:], sys.maxsize]
            is_certain = keys[:1].all() and (np.diff(stamps[ordered]) > 0).all() and stamps.min() != _NO_STAMP
            if not (is_certain and ((low[group] <= stamps) & (stamps < high[group]))[shown].all()):
                return False
            times = [video.time(number, stamp, None) for number, stamp in enumerate(stamps[ordered].tolist())]
            video.set_truncated()
        # Step 4: decode some frames to verify the order.
        self._publish(video, times, ordered, rows)
        with suppress(VideoError):
            self[min(_VERIFIED, len(self) - 1)]
            return True
        return False

    def _decode_all(self, path: Path, progress: Progress) -> None:
        """Number the frames by decoding all: a frame inherits the time stamp of its packet, here a number."""
        video, stop, total = VideoFile(path, self.settings), range(sys.maxsize)[self._part].stop, None
        times, packets, rows, upright = array("d"), array("q"), array("q"), UprightConverter()
        if count := video.count():
            total = len(range(count)[self._part])

        def numbered() -> Iterator[Packet[Any] | str | None]:
            for packet in video.packets():
                if packet is not None and not isinstance(packet, str):
                    rows.extend(_row(packet, video.damaged))
                    packet.pts = len(rows) // _COLUMNS - 1
                yield packet

        first: tuple[int, int] | None = None
        with video.container:
            try:
                for frame in video.decoded(numbered()):
                    number = -1 if frame.pts is None else frame.pts
                    stamp = rows[number * _COLUMNS + 1] if number >= 0 else _NO_STAMP
                    time = video.time(len(times), None if stamp == _NO_STAMP else stamp, frame.dts)
                    first = first or (frame.width, frame.height)
                    if (frame.width, frame.height) != first:
                        shape = self.size[1], self.size[0], 3
                        of_one_size(upright(frame), shape, self.settings.resize, path, len(times))
                        video.scaled += 1
                    times.append(time)
                    packets.append(number)
                    if len(times) % _INTERVAL == 0 and len(times) > 1.5 * len(self):
                        self._publish(video, times, packets, rows)
                    progress(len(times), total)
                    if len(times) >= stop:
                        break
                else:
                    video.set_truncated()
            finally:
                self._publish(video, times, packets, rows, exact=True)

    def _publish(self, video: VideoFile, times: Any, packets: Any, rows: array[int], *, exact: bool = False) -> None:
        with self._lock:
            self.close()
            self._index = _Index(np.array(packets), np.array(rows).reshape(-1, _COLUMNS))
            self.times, self.is_exact, self.counters = np.array(times)[self._part], exact, counters_of(video)


class _Reader:
    """Decodes the frames of a file by their number in it, with a cache; it is not thread-safe."""

    def __init__(self, frames: VideoFrames, path: Path, index: _Index) -> None:
        self._path, self._index, self._settings, (width, height) = path, index, frames.settings, frames.size
        self._shape, self._is_exact, self._upright = (height, width, 3), frames.is_exact, UprightConverter()
        self._threads = "AUTO" if frames.is_threaded and not frames.settings.skip_damaged else "NONE"
        self._video = VideoFile(path, frames.settings, self._threads)
        pixels = self._video.stream.codec_context.format
        bits = (pixels and pixels.padded_bits_per_pixel) or 24
        self._capacity = max(2, 8 * _CACHE_BYTES // (width * height * bits))
        self._cache: dict[int, VideoFrame] = {}
        self._run: Iterator[int] = iter(())  # the current decoding: fills the cache, and yields numbers of frames
        self._next = 0  # number of the frame that follows in the run

    def close(self) -> None:
        self._run = iter(())  # breaks a reference cycle, which would delay the release of memory
        self._video.container.close()

    def image(self, number: int) -> UInt8:
        if number not in self._cache:
            self._decode(number)
        image = self._upright(self._cache[number])
        return of_one_size(image, self._shape, self._settings.resize, self._path, number)

    def _decode(self, number: int) -> None:
        """Put a frame into the cache, with earlier ones unless the current run is about to decode it."""
        starts = self._index.starts
        start = bisect_right(starts, number, key=itemgetter(0)) - 1
        if starts[start][0] <= self._next <= number:
            self._cache.clear()  # reading forwards needs no cache
            if number in self._run:
                return
        begin, problem = max(starts[start][0], number - self._capacity + 1), None
        # A decoder may need more than one keyframe before its pictures are complete.
        for attempt in dict.fromkeys(max(0, start - back) for back in (0, 1, 2, start if self._is_exact else 0)):
            self._run, self._next = self._decode_from(attempt, begin), begin
            try:
                if number in self._run:
                    return
            except VideoError as error:
                problem = error
        raise problem or VideoError(f"frame {number} of {str(self._path)!r} cannot be decoded")

    def _decode_from(self, start: int, begin: int) -> Iterator[int]:
        """Decode from `start`, an index of the starts; cache the frames from `begin` on, and yield their numbers.

        The time stamp of a packet, which its frame inherits, is replaced by the number of the frame. The iterator ends
        before the first frame that is missing.
        """
        index, first = self._index, self._index.starts[start][1]
        first_packet, packets = self._seek(start)
        context = self._video.stream.codec_context
        context.flush_buffers()
        skips = context.codec.name in _SKIPPABLE and index.is_unique and not self._settings.skip_damaged

        def numbered() -> Iterator[Packet[Any] | str | None]:
            number = first_packet
            for packet in packets:
                if number == len(index.rows):
                    break
                if packet is not None and not isinstance(packet, str):
                    packet.pts = int(index.numbers[number])
                    if skips:  # frames before `begin` without references to them
                        context.skip_frame = "NONREF" if 0 <= packet.pts < begin else "DEFAULT"
                    number += 1
                if number > first:
                    yield packet
            yield None

        # Cache each frame while it follows the last one.
        for count, frame in enumerate(self._video.decoded(numbered(), begin if index.is_unique else None)):
            number = frame.pts or 0 if index.is_unique else count
            if number < begin:
                continue
            if number != self._next:
                return
            while len(self._cache) >= self._capacity:
                del self._cache[next(iter(self._cache))]  # the oldest one
            self._cache[number] = frame
            self._next += 1
            yield number

    def _seek(self, start: int) -> tuple[int, Iterator[Packet[Any] | str | None]]:
        """Return the number of a packet at or before a start, and an iterator of the packets from it on.

        The packets after a seek show its position. If they are not recognised, the file is opened again.
        """
        import av

        rows, starts = self._index.rows, self._index.starts
        for _, key in starts[start : max(0, start - _ATTEMPTS) : -1]:
            with suppress(av.FFmpegError):
                self._video.container.seek(int(rows[key, 1]), stream=self._video.stream)
                packets = self._video.packets()
                for packet in islice(packets, _ATTEMPTS):
                    if packet is not None and not isinstance(packet, str):
                        matches = np.flatnonzero((rows[:, :3] == _row(packet)[:3]).all(axis=1))
                        if len(matches) == 1 and matches[0] <= starts[start][1]:
                            return int(matches[0]), chain([packet], packets)
        self._video.container.close()
        self._video = VideoFile(self._path, self._settings, self._threads)
        return 0, self._video.packets()

"""A video file as packets and as decoded frames, in the order of the file."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Generator, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from catstream.base.settings import RunSettings
from catstream.errors import VideoError
from catstream.video.frames import RATE, Frame, UprightConverter, ffmpeg_reason, open_video, video_stream
from catstream.video.images import EXPECTED, of_one_size
from catstream.video.times import FrameClock

if TYPE_CHECKING:
    from av import Packet, VideoFrame

#: Number of successive errors of the container after which a file is treated as ended.
_MAX_FAILURES = 3

#: Missing seconds at the end, by its header, above which a Matroska file is reported as truncated.
_TRUNCATED_SECONDS = 1.0

#: The frames of a larger file (in bytes) are estimated from its duration instead of being counted.
_MAX_COUNTED_BYTES = 1 << 30


class VideoFile:
    """A video file, which is read once."""

    images: Sequence[Path] = ()

    def __init__(self, path: Path, settings: RunSettings, thread_type: str = "NONE") -> None:
        import av  # imported here because it takes 0.1 s and folders do not need it

        self.path, self.settings = path, settings
        self.damaged = 0  #: number of skipped packets
        self.scaled = 0  #: number of frames that had another size than the first one
        self.truncated = 0  #: seconds of the stated duration after the last frame
        try:
            self.container = open_video(str(path.absolute()), settings.hwaccel)
        except (av.FFmpegError, OSError) as error:
            raise VideoError(f"{str(path)!r} is not a video that can be read ({error.strerror}): {EXPECTED}") from None
        self.stream = video_stream(self.container)
        # FFmpeg opens any text file as a video of its text (format "tty").
        if self.stream is None or self.container.format.name == "tty":
            self.container.close()
            raise VideoError(f"there is no video in {str(path)!r}: {EXPECTED}")
        self.stream.thread_type = thread_type  # "NONE": the processes of the pipeline already use the cores
        # An AVI has times of decoding only; its demuxer states them as times of presentation.
        self._is_avi = self.container.format.name == "avi"
        # A stream without a container, as raw H.264, has no time stamps, but may state its rate.
        has_times = not av.format.Flags(self.container.format.flags) & av.format.Flags.no_timestamps
        self.pixel_aspect = self.stream.sample_aspect_ratio or Fraction(1)
        self.rate = float((has_times and self.stream.average_rate) or self.stream.guessed_rate or RATE)
        self._clock, self._end = FrameClock(self.rate, self.stream.time_base if has_times else None), 0.0

    def count(self) -> int | None:
        """Return the number of frames: index entries that hold pictures, or else packets."""
        video = VideoFile(self.path, self.settings)
        with video.container:
            index, stated = video.stream.index_entries, video.stream.frames
            if 0 < stated <= len(index):
                # Entries without data repeat the previous frame; discarded entries precede a cut.
                return sum(entry.size > 0 and not entry.is_discard for entry in index) or None
            if self.path.stat().st_size > _MAX_COUNTED_BYTES:
                return stated or round((video.container.duration or 0) / 1e6 * self.rate) or None
            return sum(not isinstance(packet, str) for packet in video.packets()) - 1 or None

    def frames(self, wanted: range, start: int) -> Generator[Frame]:
        """Yield the frames with these numbers, from the one at index `start` on."""
        shape, upright, rest = None, UprightConverter(), wanted[start:]
        with self.container:
            for number, frame in enumerate(self.decoded(self.packets())):
                time = self.time(number, frame.pts, frame.dts)
                if number in rest or (number in wanted and shape is None):
                    image = upright(frame)
                    if shape is None:
                        shape = image.shape
                        if shape[0] != frame.height:  # rotated
                            self.pixel_aspect = 1 / self.pixel_aspect
                    scaled = of_one_size(image, shape, self.settings.resize, self.path, number)
                    self.scaled += scaled is not image
                    if number in rest:
                        yield Frame(wanted.index(number), time, scaled)
                if number + 1 >= wanted.stop:  # do not read on: damage after the part is no error
                    return
            self.set_truncated()

    def time(self, number: int, pts: int | None, dts: int | None) -> float:
        """Return the time of frame `number`, the next one, in seconds, from its time stamps in ticks."""
        self._end = max(self._end, float((pts or 0) * self.stream.time_base))
        return self._clock.time(number, None if self._is_avi else pts, dts)

    def set_truncated(self) -> None:
        """Compare the time of the last frame with the duration in the header of a Matroska file.

        FFmpeg reads a truncated file of this kind without an error. For others, it reports an error, or estimates the
        duration from the available data.
        """
        if "matroska" not in self.container.format.name:
            return
        end = (self.container.duration or 0) / 1e6
        if tag := re.fullmatch(r"(\d+):(\d+):([\d.]+)", self.stream.metadata.get("DURATION", "")):  # without the sound
            hours, minutes, seconds = map(float, tag.groups())
            end = 3600 * hours + 60 * minutes + seconds
        if end - self._end > _TRUNCATED_SECONDS:
            self.truncated = round(end - self._end)

    def decoded(self, packets: Iterable[Packet[Any] | str | None], begin: int | None = None) -> Iterator[VideoFrame]:
        """Yield decoded frames. At an error, raise VideoError, or continue at the next keyframe.

        begin : drop frames with an earlier time stamp, even damaged ones
        """
        import av

        decoder, skip, good = self.stream.codec_context, self.settings.skip_damaged, 0
        waits_for_key = is_spoilt = False  # after an error of a packet, and after a damaged frame
        for packet in packets:
            if waits_for_key and isinstance(packet, av.Packet) and not packet.is_keyframe:
                self.damaged += 1
                continue
            # Step 1: decode the packet. After an error, fetch the earlier frames, and reset the decoder.
            frames: list[VideoFrame] = []
            problem = packet if isinstance(packet, str) else ""
            try:
                frames = [] if problem else decoder.decode(packet)
            except av.FFmpegError as error:
                problem = ffmpeg_reason(error)
            waits_for_key = bool(problem)
            if problem and skip:
                self.damaged += 1
                with contextlib.suppress(av.FFmpegError):  # the decoder still has earlier frames
                    frames = decoder.decode(None)
                decoder.flush_buffers()
            # Step 2: yield the intact frames. Damage lasts until the next keyframe.
            for frame in frames:
                if begin is not None and (frame.pts or 0) < begin:
                    continue
                is_spoilt = frame.is_corrupt or (is_spoilt and not frame.key_frame)
                if is_spoilt and not skip:
                    problem = "the picture cannot be decoded"
                    break
                if is_spoilt:
                    self.damaged += 1
                else:
                    yield frame
                    good += 1
            if problem and not skip:
                raise VideoError(
                    f"{str(self.path)!r} is damaged at frame {good} ({problem}): "
                    "--skip-damaged (run.skip_damaged=true) continues at the next keyframe"
                )

    def packets(self) -> Iterator[Packet[Any] | str | None]:
        """Yield the packets that hold data, the reason of each error of the container, and None at the end."""
        import av

        packets, failures = self.container.demux(self.stream), 0
        while failures < _MAX_FAILURES:
            try:
                packet = next(packets, None)
            except av.FFmpegError as error:
                packets = self.container.demux(self.stream)  # continues at the current position
                if not isinstance(error, av.BlockingIOError):  # which means: try again
                    failures += 1
                    yield ffmpeg_reason(error)
                continue
            if packet is None:
                break
            if packet.size:
                failures = 0
                # FFmpeg marks the first packet of a joined MPEG-TS file. The decoder reports real damage.
                packet.is_corrupt = False
                yield packet
        yield None

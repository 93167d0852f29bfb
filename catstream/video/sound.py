"""Copies the sound of a video file, without re-encoding, into a video that is being written."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from catstream.video.frames import ffmpeg_reason, time_base, video_stream

if TYPE_CHECKING:
    from av import AudioStream, Packet
    from av.container import InputContainer, OutputContainer

_log = logging.getLogger(__name__)


class Sound:
    """Copies the first sound track of a file; does nothing if there is none, or the new container does not support it.

    Parameters
    ----------
    path : file with the sound, None for no sound
    container : `av.container.OutputContainer` to copy to, before its first packet
    """

    def __init__(self, path: Path | None, container: OutputContainer) -> None:
        self._source: InputContainer | None = None
        if path is None:
            return
        import av

        try:
            source = av.open(str(path.absolute()))
        except (av.FFmpegError, OSError) as error:
            _log.warning("the sound of %s is left out: it cannot be read (%s)", path, error.strerror)
            return
        try:
            self._stream = source.streams.audio[0]
            self._copy = container.add_stream_from_template(self._stream)
        except IndexError:
            source.close()
            return
        except ValueError as error:
            _log.warning("the sound of %s is left out: %s", path, error)
            source.close()
            return
        picture = video_stream(source)
        self._zero = float((picture.start_time or 0) * time_base(picture))
        self._source, self._container = source, container
        self._packets = source.demux(self._stream)
        self._next: Packet[AudioStream] | None = None

    def copy(self, start: float, end: float) -> None:
        """Copy the sound from `start` up to `end`, in seconds of the source. Calls must be in order of time."""
        import av

        while self._source is not None:
            try:
                packet = self._next or next(self._packets)
            except (StopIteration, av.FFmpegError) as error:
                if isinstance(error, av.FFmpegError):
                    _log.warning("the sound ends at %.1f s: %s", end, ffmpeg_reason(error))
                self.close()
                return
            self._next = None
            if packet.pts is None or packet.dts is None:
                continue
            time = float(packet.pts * packet.time_base) - self._zero
            if time >= end:
                self._next = packet
                return
            if time >= start:
                shift = round((start + self._zero) / packet.time_base)
                packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, self._copy
                self._container.mux(packet)

    def close(self) -> None:
        """Close the file with the sound."""
        if self._source is not None:
            self._source.close()
            self._source = None

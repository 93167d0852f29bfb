"""NAL units of H.264 as RTP transports them, for a decoder that does not wait for the next frame.

FFmpeg's parser passes a frame on when the next one begins, because the last unit of a frame has no mark: this is a
delay of one frame. Without the parser, FFmpeg passes on the content of each RTP packet (RFC 6184): whole units, or a
fragment of one. All fragments of a unit but the last have one length, so a shorter one ends it; and a decoder with the
flag for chunks returns a frame as soon as it has the last macroblock.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from av import Packet

#: Options of FFmpeg for RTP packets without delay.
OPTIONS = {"fflags": "noparse", "probesize": "32", "analyzeduration": "1"}

_START = b"\0\0\0\1"  # of a unit, which FFmpeg writes before its header
_TYPE = 0x1F  # of the byte after it
_KEY_TYPES = {5, 7, 8}  # a slice of a keyframe, and the parameters of a sequence and of a picture
_SLICE_TYPES = {1, 5}
_FIRST = 0x80  # bit of the byte after it, set in the first slice of a frame


class NalUnits:
    """Joins fragments. A unit whose last fragment is as long as the others is returned when the next one begins."""

    def __init__(self) -> None:
        self._unit = b""  # so far
        self._length = 0  # of its first fragment
        self._longest = 0  # of a fragment that was not the last one of its unit
        self._pts: int | None = None

    def take(self, packet: Packet[Any]) -> Iterator[Packet[Any]]:
        """Yield the units that are whole after this packet.

        ValueError if a unit was split in another way, or a frame has several slices: the decoder would conceal the
        missing ones after each of them.
        """
        data = bytes(packet)
        if data.startswith(_START) or not data:
            yield from self._whole(packet)
            self._unit, self._length, self._pts = data, len(data) - len(_START) - 1, packet.pts
            is_whole = self._length < self._longest
        elif not self._unit:
            raise ValueError("a NAL unit continues after a fragment that was shorter than the first one")
        else:
            self._unit += data
            self._longest = max(self._longest, self._length)
            is_whole = len(data) < self._length
        if is_whole:
            yield from self._whole(packet)

    def _whole(self, packet: Packet[Any]) -> Iterator[Packet[Any]]:
        import av

        if self._unit:
            unit: Packet[Any] = av.Packet(self._unit)
            unit.pts, unit.time_base = self._pts, packet.time_base
            header, *content = self._unit[len(_START) : len(_START) + 2]
            if header & _TYPE in _SLICE_TYPES and content and content[0] < _FIRST:
                raise ValueError("a frame has several slices")
            unit.is_keyframe = header & _TYPE in _KEY_TYPES
            self._unit = b""
            yield unit

"""MJPEG over HTTP for the camera of a load test, in a NUT container, which FFmpeg reads without delay."""

from __future__ import annotations

from fractions import Fraction
from http.server import BaseHTTPRequestHandler
from typing import Any

_TICKS_PER_SECOND = 1_000_000  # time base of the stream


class MjpegConnection(BaseHTTPRequestHandler):
    """The connection of one receiver: sends frames until the receiver disconnects."""

    disable_nagle_algorithm = True  # otherwise the end of a frame would wait 40 ms for a delayed acknowledgement

    def do_GET(self) -> None:
        import av

        server: Any = self.server
        self.send_response(200)
        self.send_header("Content-Type", "video/x-nut")
        self.end_headers()
        self._is_connected, clock = True, Fraction(1, _TICKS_PER_SECOND)
        with av.open(self, "w", format="nut", options={"flush_packets": "1"}) as container:
            track: Any = container.add_stream("mjpeg")
            track.width, track.height = server.size
            track.pix_fmt, track.time_base = "yuvj420p", clock
            for moment, picture in server.frames(int(self.path.strip("/"))):
                packet = av.Packet(picture)
                packet.stream, packet.time_base, packet.is_keyframe = track, clock, True
                packet.pts = packet.dts = round(moment * _TICKS_PER_SECOND)
                container.mux(packet)
                if not self._is_connected:
                    break

    def write(self, data: bytes) -> int:
        """Write for PyAV. An error is only recorded, because PyAV would raise it again at the end of the container."""
        try:
            self.wfile.write(data)
        except OSError:
            self._is_connected = False
        return len(data)

    def log_message(self, *_: object) -> None:
        pass

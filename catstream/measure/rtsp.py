"""H.264 over RTSP for the camera of a load test, in the format of network cameras.

The video is encoded before the load test, so a stream takes little processor time from the pipelines. RTP is
interleaved with RTSP (RFC 2326, section 10.12), in packets of RFC 6184. The response to PLAY contains the due time of
the first frame as its position, from which FFmpeg counts. Therefore the time stamp of each frame is its due time,
modulo the 32 bits of RTP. Real servers send no position, so the age of their frames is unknown.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from http.client import parse_headers
from socketserver import StreamRequestHandler
from struct import pack
from threading import Thread
from typing import Any

_CLOCK = 90_000  # ticks per second of RTP time stamps of video
_PERIOD = 2**32 / _CLOCK  # seconds
_PAYLOAD = 1400  # maximum bytes, so that a packet fits into an Ethernet frame
_FRAGMENT = 28  # type of a packet with a fragment of a NAL unit (FU-A)
_DESCRIPTION = (
    b"v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=load test\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\n"
    b"a=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\na=control:video\r\n"
)


def due_time(pts: float, arrival: float) -> float:
    """Return the due time of a frame from its time stamp, which FFmpeg may shift by periods, and its track's arrival.

    >>> due_time(pts=1000.0, arrival=1000.1), round(due_time(pts=-1.0, arrival=47721.0), 3)
    (1000.0, 47720.859)
    """
    return pts + _PERIOD * round((arrival - pts) / _PERIOD)


def payloads(unit: bytes) -> Iterator[bytes]:
    """Yield the RTP payloads of an access unit: its NAL units, large ones in fragments.

    >>> [len(part) for part in payloads(b"\\0\\0\\0\\1" + b"a" * 9 + b"\\0\\0\\1" + b"b" * 1500)]
    [9, 1402, 101]
    """
    for nal in re.split(rb"\x00{2,3}\x01", unit)[1:]:
        if len(nal) <= _PAYLOAD:
            yield nal
            continue
        for begin in range(1, len(nal), _PAYLOAD):
            is_last = begin + _PAYLOAD >= len(nal)
            flags = (begin == 1) << 7 | is_last << 6
            yield bytes([nal[0] & 0xE0 | _FRAGMENT, flags | nal[0] & 0x1F]) + nal[begin : begin + _PAYLOAD]


class RtspConnection(StreamRequestHandler):
    """The connection of one receiver: answers FFmpeg's requests, then sends frames until the receiver disconnects."""

    disable_nagle_algorithm = True

    def handle(self) -> None:
        server: Any = self.server
        with suppress(OSError):  # the receiver has disconnected
            while line := self.rfile.readline().decode():
                method, address, _ = line.split()
                headers = parse_headers(self.rfile)
                count = f"CSeq: {headers['CSeq']}\r\nSession: 1\r\n"
                if method == "PLAY":
                    # Read and ignore the receiver's reports, which would fill up the connection.
                    Thread(target=self._read_all, daemon=True).start()
                    self._play(server.frames(int(address.strip("/").split("/")[3])), count)
                    return
                status, more, body = "200 OK", "", b""
                if method == "DESCRIBE":
                    more, body = "Content-Type: application/sdp\r\n", _DESCRIPTION
                elif method == "SETUP" and "TCP" in headers["Transport"]:
                    more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n"
                elif method == "SETUP":
                    status = "461 Unsupported Transport"
                more += f"Content-Length: {len(body)}\r\n"
                self.wfile.write(f"RTSP/1.0 {status}\r\n{count}{more}\r\n".encode() + body)

    def _play(self, frames: Iterator[tuple[float, bytes]], count: str) -> None:
        number, is_first = 0, True
        for moment, unit in frames:
            if is_first:
                self.wfile.write(f"RTSP/1.0 200 OK\r\n{count}Range: npt={moment:.6f}-\r\n\r\n".encode())
                is_first = False
            sent, parts = b"", list(payloads(unit))
            for part in parts:
                marker = (part is parts[-1]) << 7
                stamp = round(moment * _CLOCK) & 0xFFFFFFFF
                packet = pack("!BBHII", 0x80, marker | 96, number & 0xFFFF, stamp, 1) + part
                sent, number = sent + b"$" + pack("!BH", 0, len(packet)) + packet, number + 1
            self.wfile.write(sent)

    def _read_all(self) -> None:
        with suppress(OSError):
            while self.connection.recv(4096):
                pass

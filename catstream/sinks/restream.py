"""The pictures of a running pipeline with their boxes, live, as H.264 on an RTSP or RTMP server of the user's.

They are pushed by a process of its own, because FFmpeg blocks all threads of a process while a server does not answer.
It is this module, run with `-m`: it reads the address of the server and that of the pipeline from standard input,
and writes a byte for each picture that the server accepted. The stream needs the size of a picture, so the first one
is awaited before the first attempt to connect. From then on, the pipeline makes pictures only while it is connected.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from contextlib import closing, suppress
from dataclasses import asdict
from itertools import chain
from threading import Thread
from time import monotonic, sleep
from typing import IO, cast
from urllib.parse import urlsplit

import numpy as np

from catstream.base.text import counted
from catstream.client.address import Address
from catstream.client.attach import subscribe
from catstream.errors import CatstreamError, SilenceError, VideoError
from catstream.jobs.job import SinkOptions
from catstream.sinks.destinations import Origin, TrackedFrame, redacted
from catstream.sinks.remote import Warnings, reason_of, split
from catstream.sinks.video_sink import DrawnPictures
from catstream.video.writer import VideoWriter

_LATE_SECONDS = 2.0  # without a picture, after which the frames that pass are missed
_STUCK_SECONDS = 15  # in which a server has to accept a connection or a picture
_PAUSE_SECONDS = 2.0  # between two attempts to connect
_RATE = 10  # pictures per second that a pipeline sends at most
_REPEAT_SECONDS = 1.0  # without a track, after which the last picture is sent again: servers drop a silent stream


class StreamSink:
    """Starts the process, restarts it if it dies, and counts the frames that it misses.

    missed  frames that passed while the server accepted no picture, because it was away or slow
    """

    def __init__(self, place: str, origin: Origin) -> None:
        self._place, self._origin, self._warnings, self.missed = place, origin, Warnings(place), 0
        self._frame = -1  # the last one
        self._accepted = 0.0  # newest moment at which the server is known to have accepted a picture
        self._start()

    @staticmethod
    def check(place: str, _: SinkOptions) -> None:
        """Raise VideoError if this is no address of a stream."""
        form = f"{place.partition('://')[0]}://[USER:PASSWORD@]HOST[:PORT]/PATH"
        if split(place, form).path in ("", "/"):
            raise VideoError(f"{redacted(place)} does not name a stream: expected {form}")

    def write(self, frame: TrackedFrame) -> None:
        """Count the frame if it is missed; the process receives the tracks from the pipeline itself."""
        if self._process.poll() and monotonic() - self._started > _PAUSE_SECONDS:
            is_stuck = self._process.returncode == -signal.SIGALRM
            self._warnings.failed(f"{f'no data accepted for {_STUCK_SECONDS} s' if is_stuck else 'died'}; reconnecting")
            self._stop()
            self._start()
        with suppress(BlockingIOError):
            if os.read(self._output, 4096):
                self._accepted = monotonic()
                self._warnings.working()
        if frame.number != self._frame and monotonic() - self._accepted > _LATE_SECONDS:
            self.missed += 1
        self._frame = frame.number

    def close(self) -> None:
        """End the process, and warn about what the server missed."""
        self._stop()
        if self.missed:
            self._warnings.log(f"{counted(self.missed, 'frame')} passed while it was away or slow")

    def _start(self) -> None:
        self._started = monotonic()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for this process
        )
        stdin, stdout = cast(IO[bytes], self._process.stdin), cast(IO[bytes], self._process.stdout)
        stdin.write(json.dumps([self._place, asdict(self._origin.address)]).encode() + b"\n")
        stdin.flush()
        self._output = stdout.fileno()
        os.set_blocking(self._output, False)

    def _stop(self) -> None:
        with self._process:
            self._process.kill()


def push(place: str, origin: Origin) -> None:
    """Push to a server until the pipeline ends; reconnect if the connection fails."""
    warnings, url = Warnings(place), urlsplit(place)
    with closing(_pictures(origin)) as pictures:
        image = next(pictures, None)
    while image is not None:
        signal.alarm(_STUCK_SECONDS)  # which kills this process
        try:
            socket.getaddrinfo(url.hostname, None)  # FFmpeg does not say that a host is unknown
            with (
                closing(VideoWriter(place, _RATE, (image.shape[1], image.shape[0]))) as stream,
                closing(_pictures(origin, image)) as pictures,
            ):
                for picture in chain([image], pictures):
                    signal.alarm(_STUCK_SECONDS)
                    stream.write(picture, monotonic())
                    signal.alarm(0)
                    warnings.working()
                    with suppress(BlockingIOError):  # nobody reads while no track arrives
                        os.write(1, b".")
            return
        except (OSError, CatstreamError) as error:
            signal.alarm(0)
            warnings.failed(f"not connected ({reason_of(error.__cause__ or error)}); reconnecting")
        sleep(_PAUSE_SECONDS)


def _pictures(origin: Origin, image: np.ndarray | None = None) -> Generator[np.ndarray]:
    """Yield each picture until the pipeline ends, and while no tracks arrive the last one again, `image` at first."""
    with (
        subscribe(origin.address, "tracks", timeout=_REPEAT_SECONDS) as tracks,
        closing(DrawnPictures(origin)) as pictures,
    ):
        while True:
            try:
                track = next(tracks, None)
            except SilenceError:
                if image is not None:
                    yield image
                continue
            if track is None:
                return
            if (drawn := pictures.update(TrackedFrame([track]))) is not None:
                image = drawn[0]
                yield image


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    server, address = json.loads(sys.stdin.readline())
    Thread(target=_end_with_parent, daemon=True).start()
    os.set_blocking(1, False)
    push(server, Origin(address=Address(**address)))

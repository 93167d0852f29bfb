"""The pictures of a pipeline on a server: drawn only while it is connected, and what it misses is counted."""

import os
import shutil
import signal
import subprocess
import time
from contextlib import ExitStack, closing, contextmanager

import numpy as np
import psutil
import pytest

from catstream.base.box import Box
from catstream.client.address import Address
from catstream.messages.kinds import Preview, Track
from catstream.sinks.destinations import Origin, TrackedFrame, open_sink
from catstream.video.frames import jpeg
from catstream.video.source import open_source
from catstream.wire.channels import PREVIEWS, TRACKS
from catstream.wire.newest import Publisher

pytestmark = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="no RTMP server: apt-get install ffmpeg")

BOX = Box(200.0, 100.0, 120.0, 160.0)


class Pipeline:
    """What a detector sends: a track and a picture for each frame, twenty a second."""

    def __init__(self, endpoint, stack):
        self.frame, self.has_subscribers = 0, False
        self._tracks = stack.enter_context(Publisher(TRACKS, endpoint))
        self._previews = stack.enter_context(Publisher(PREVIEWS, endpoint))
        self._noise = np.random.default_rng(5).integers(90, 110, (9, 240, 320, 3), np.uint8)

    def next(self):
        for each in (self._tracks, self._previews):
            each.serve_late_joiners()
        track = Track(self.frame, self.frame / 20, "present", BOX, 0.9, 1)
        picture = jpeg(self._noise[self.frame % 9])
        self._previews.send(Preview(self.frame, track.time, 640, 480, {"": BOX}, picture))
        self._tracks.send(track)
        self.has_subscribers = self._previews.has_subscribers
        self.frame += 1
        time.sleep(0.05)
        return TrackedFrame([track])


@contextmanager
def rtmp_server(path, port):
    """FFmpeg as a server, which accepts a single connection, and then starts again."""
    words = f"ffmpeg -loglevel error -listen 1 -i rtmp://127.0.0.1:{port}/live/one -c copy -flush_packets 1 -y {path}"
    loop = subprocess.Popen(
        ["sh", "-c", f"while :; do {words}; done"], start_new_session=True, stderr=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        os.killpg(loop.pid, signal.SIGKILL)
        loop.wait()


def test_pictures_are_made_and_sent_only_while_the_server_is_there(endpoint, tcp, tmp_path, until, caplog):
    port = int(tcp.rpartition(":")[2])
    path = tmp_path / "got.flv"
    with ExitStack() as stack:
        pipeline = Pipeline(endpoint, stack)
        sink = stack.enter_context(
            closing(open_sink(f"rtmp://127.0.0.1:{port}/live/one", Origin(address=Address(str(endpoint)))))
        )
        for is_subscribed in (True, False):  # the size of the stream is that of the first picture
            until(lambda: pipeline.has_subscribers == is_subscribed, lambda: sink.write(pipeline.next()))  # noqa: B023
        for _ in range(60):  # the server is away
            sink.write(pipeline.next())
            assert not pipeline.has_subscribers
        assert sink.missed == pipeline.frame
        with rtmp_server(path, port):
            until(lambda: path.exists() and path.stat().st_size > 9000, lambda: sink.write(pipeline.next()))
            assert pipeline.has_subscribers
            missed = sink.missed
            with open_source(path) as frames:
                image = next(iter(frames)).image
            children = psutil.Process().children()  # the server, and those of other tests, are too
            (pushing,) = (child for child in children if "catstream.sinks.restream" in child.cmdline())
            pushing.kill()
            until(lambda: not pipeline.has_subscribers, lambda: sink.write(pipeline.next()))
            until(lambda: pipeline.has_subscribers, lambda: sink.write(pipeline.next()))
        assert image.shape[:2] == (260, 320), "the picture, and a line of text"
        green = (image[:240].astype(int) @ [-1, 2, -1]) > 200
        assert (np.ptp(np.argwhere(green), axis=0) - [80, 60]).max() < 6, "the box is drawn"
    assert sink.missed >= missed
    assert f"rtmp://127.0.0.1:{port}/live/one: {sink.missed} frames passed while it was away or slow" in caplog.text

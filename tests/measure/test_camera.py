"""The camera sends each frame at its due time over HTTP or RTSP, and drops none for a slow receiver."""

import socket
import threading
import time

import numpy as np
import pytest

from catstream.measure import camera
from catstream.measure.camera import Broadcast, Schedule
from catstream.measure.rtsp import due_time
from catstream.video.frames import jpeg
from catstream.video.source import open_source
from catstream.video.writer import Encoder

SIZE = (64, 48)


@pytest.fixture(scope="module")
def videos():
    """Images that get brighter by 60 grey levels each, by the source."""
    encoder, images = Encoder(SIZE, rate=25), [np.full((48, 64, 3), 60 * n, np.uint8) for n in range(4)]
    packets = [packet for image in images for packet in encoder.packets(image)]
    return {"mjpeg": list(map(jpeg, images)), "h264": [bytes(packet) for packet in [*packets, *encoder.flush()]]}


@pytest.fixture
def broadcast(videos):
    def made(source, streams=1):
        return Broadcast(source, SIZE, videos[source], streams=streams)

    return made


# An RTP time stamp has 32 bits and begins again after 47,721 s.
@pytest.mark.parametrize(("source", "ahead"), [("mjpeg", 0), ("h264", 0), ("h264", 47_719), ("h264", 10**6)])
def test_time_stamp_of_a_frame_is_its_due_time(broadcast, monkeypatch, source, ahead):
    begin = time.monotonic() - ahead
    monkeypatch.setattr(camera, "monotonic", lambda: time.monotonic() - begin)
    numbers = []
    with broadcast(source) as sender:
        (schedule,) = sender.play(Schedule(camera.monotonic() + 1.3, 20.0))
        with open_source(*sender.urls) as frames:
            for frame in frames:
                if frame.pts is not None:
                    pts = due_time(frame.pts, camera.monotonic())
                    numbers.append(schedule.number(pts))
                    assert pts == pytest.approx(schedule.due(numbers[-1]), abs=1e-4)
                    assert round(frame.image.mean() / 60) == max(0, numbers[-1]) % 4
                    if numbers[-1] >= 15:
                        break


def test_streams_are_shifted_by_a_part_of_a_frame(broadcast):
    with broadcast("mjpeg", streams=2) as sender:
        one, other = sender.play(Schedule(100.0, 20.0))
    assert (one.start, other.start) == (100.0, 100.025)


def test_slow_receiver_gets_every_frame(broadcast):
    with broadcast("h264") as sender, socket.create_connection(sender.server_address) as receiver:
        (schedule,) = sender.play(Schedule(time.monotonic(), 100.0))
        receiver.sendall(b"PLAY rtsp://127.0.0.1/0 RTSP/1.0\r\nCSeq: 1\r\n\r\n")
        while schedule.following(time.monotonic()) < 30:
            time.sleep(0.01)  # it reads nothing: what is sent meanwhile waits
        data, packets = b"", []
        while len(packets) <= 30:  # the last one may be cut
            data += receiver.recv(65536)
            packets = [int.from_bytes(part[4:6]) for part in data.split(b"$\x00")[1:] if part[2:3] == b"\x80"]
    assert packets[:30] == [*range(packets[0], packets[0] + 30)]


@pytest.mark.parametrize("source", ["mjpeg", "h264"])
def test_receiver_that_disconnects_ends_its_connection_only(broadcast, source, until, capfd):
    with broadcast(source) as sender:
        sender.play(Schedule(time.monotonic(), 100.0))
        before = threading.active_count()
        for _ in range(2):
            with open_source(*sender.urls) as frames:
                assert next(iter(frames)).image.shape == (48, 64, 3)
        until(lambda: threading.active_count() <= before)
    assert capfd.readouterr().err == ""

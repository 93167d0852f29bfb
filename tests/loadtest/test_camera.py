"""The camera sends each frame at its due time over RTSP, and drops none for a slow receiver."""

import socket
import threading
import time

import numpy as np
import pytest

from catstream.loadtest import camera
from catstream.loadtest.camera import Broadcast, Schedule
from catstream.loadtest.rtsp import due_time
from catstream.video.source import open_source
from catstream.video.writer import Encoder

SIZE = (64, 48)


@pytest.fixture(scope="module")
def units():
    """Access units of grey images that get brighter by 60 grey levels each."""
    encoder = Encoder(SIZE, rate=25)
    packets = [packet for n in range(4) for packet in encoder.packets(np.full((48, 64, 3), 60 * n, np.uint8))]
    return [bytes(packet) for packet in [*packets, *encoder.flush()]]


@pytest.mark.parametrize("ahead", [0, 47_719, 10**6])  # an RTP time stamp has 32 bits and begins again after 47,721 s
def test_time_stamp_of_a_frame_is_its_due_time(units, monkeypatch, ahead):
    begin = time.monotonic() - ahead
    monkeypatch.setattr(camera, "monotonic", lambda: time.monotonic() - begin)
    numbers = []
    with Broadcast(units) as broadcast:
        (schedule,) = broadcast.play(Schedule(camera.monotonic() + 1.3, 20.0))
        with open_source(*broadcast.urls) as source:
            for frame in source:
                if frame.pts is not None:
                    pts = due_time(frame.pts, camera.monotonic())
                    numbers.append(schedule.number(pts))
                    assert pts == pytest.approx(schedule.due(numbers[-1]), abs=1e-4)
                    assert round(frame.image.mean() / 60) == max(0, numbers[-1]) % len(units)
                    if numbers[-1] >= 15:
                        break
    assert numbers[0] < 0, "it begins with the still"


def test_streams_are_shifted_by_a_part_of_a_frame(units):
    with Broadcast(units, streams=2) as broadcast:
        one, other = broadcast.play(Schedule(100.0, 20.0))
    assert (one.start, other.start) == (100.0, 100.025)


def test_slow_receiver_gets_every_frame(units):
    with Broadcast(units) as broadcast, socket.create_connection(broadcast.server_address) as receiver:
        (schedule,) = broadcast.play(Schedule(time.monotonic(), 100.0))
        receiver.sendall(b"PLAY rtsp://127.0.0.1/0 RTSP/1.0\r\nCSeq: 1\r\n\r\n")
        while schedule.following(time.monotonic()) < 30:
            time.sleep(0.01)  # it reads nothing: what is sent meanwhile waits
        data = b""
        while schedule.following(time.monotonic()) < 60:
            data += receiver.recv(65536)
    packets = [int.from_bytes(part[4:6]) for part in data.split(b"$\x00")[1:] if part[2:3] == b"\x80"]
    assert packets[:30] == [*range(packets[0], packets[0] + 30)]


def test_receiver_that_disconnects_ends_its_connection_only(units, until, capfd):
    with Broadcast(units) as broadcast:
        broadcast.play(Schedule(time.monotonic(), 100.0))
        before = threading.active_count()
        for _ in range(2):
            with open_source(*broadcast.urls) as source:
                assert next(iter(source)).image.shape == (48, 64, 3)
        until(lambda: threading.active_count() <= before)
    assert capfd.readouterr().err == ""

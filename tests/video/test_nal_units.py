"""H.264 over RTSP without FFmpeg's parser: fragments are joined, and no frame waits for the next one."""

import re
import threading
from fractions import Fraction
from itertools import islice

import av
import numpy as np
import pytest

from catstream.measure import rtsp
from catstream.measure.camera import Broadcast
from catstream.video.nal_units import NalUnits
from catstream.video.source import open_source
from catstream.video.writer import Encoder

START = b"\0\0\0\1"
LONGEST = 100  # bytes of a fragment


def unit(size, kind=1):
    return START + bytes([kind]) + b"\xaa" * size  # the first slice of a frame


def fragments(whole):
    """The packets of FFmpeg's demuxer: the start and the header of the unit are in the first one."""
    first = len(START) + 1 + LONGEST
    return [whole[:first], *(whole[at : at + LONGEST] for at in range(first, len(whole), LONGEST))]


def packet(content, pts=0):
    made = av.Packet(content)
    made.pts, made.time_base = pts, Fraction(1, 25)
    return made


def taken(units, *parts):
    return [[bytes(whole) for whole in units.take(packet(part))] for part in parts]


def test_shorter_fragment_ends_a_unit():
    units, one = NalUnits(), unit(250)
    assert taken(units, *fragments(one)) == [[], [], [one]]
    assert taken(units, unit(40)) == [[unit(40)]]


def test_next_unit_ends_one_with_fragments_of_equal_length():
    units, one, other = NalUnits(), unit(200), unit(150)
    assert taken(units, *fragments(one), *fragments(other)) == [[], [], [one], [other]]


def test_fragment_after_a_shorter_one_is_an_error():
    units = NalUnits()
    taken(units, *fragments(unit(250)))
    with pytest.raises(ValueError, match="shorter"):
        taken(units, b"\xaa" * 10)


def test_second_slice_of_a_frame_is_an_error():
    units = NalUnits()
    taken(units, unit(40), *fragments(unit(150)))
    with pytest.raises(ValueError, match="several slices"):
        taken(units, START + b"\1" + b"\x55" * 40, unit(40))


def test_unit_has_the_time_and_type_of_its_first_fragment():
    units, found = NalUnits(), []
    for pts, kind in enumerate((7, 8, 5, 1)):
        for part in fragments(unit(200, kind)):
            found += units.take(packet(part, pts))
    assert [(whole.pts, whole.is_keyframe) for whole in found] == [(0, True), (1, True), (2, True)]


class _Acknowledged(Broadcast):
    """Sends each frame after the previous one was received."""

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.received = threading.Semaphore(1)

    def frames(self, _):
        for number, access_unit in enumerate(self._units):
            self.received.acquire(timeout=500)
            yield 1 + number / 25, access_unit


@pytest.fixture
def access_units(rng):
    """H.264 access units, all of them larger than a packet."""
    encoder = Encoder((240, 160), rate=25)
    noise = rng.integers(0, 256, (12, 160, 240, 3), np.uint8)
    return [bytes(packet) for image in noise for packet in encoder.packets(image)]


def test_rtsp_frame_does_not_wait_for_the_next(access_units):
    assert min(map(len, access_units)) > 1400
    with (
        _Acknowledged("h264", (240, 160), access_units) as camera,
        open_source(*camera.urls, read_timeout_seconds=15) as source,
    ):
        seen = []
        for frame in source:
            seen.append(round((frame.pts or 1) * 25 - 25))
            camera.received.release()
            if len(seen) == len(access_units):
                break
    assert seen == [*range(len(access_units))]


def test_fragments_of_several_lengths_are_read_with_the_parser(access_units, monkeypatch):
    monkeypatch.setattr(rtsp, "payloads", shrinking)
    with Broadcast("h264", (240, 160), access_units) as camera, open_source(*camera.urls) as source:
        assert next(source).image.shape == (160, 240, 3)
        assert source.counters["reconnects"] == 0


class _Freezing(Broadcast):
    """Sends three frames on its first connection and then none; on the next one, all."""

    connections = 0

    def frames(self, stream):
        self.connections += 1
        yield from islice(super().frames(stream), 3 if self.connections == 1 else None)
        self._closed.wait()


def test_frozen_rtsp_camera_is_reconnected(access_units, caplog):
    with (
        _Freezing("h264", (240, 160), access_units) as camera,
        open_source(*camera.urls, read_timeout_seconds=0.5) as source,
    ):
        assert [next(source).number for _ in range(6)] == [*range(6)]
        assert source.counters["reconnects"] >= 1
    assert "lost source 0 (no data: check the camera" in caplog.text


def shrinking(access_unit):
    """The RTP payloads of an access unit whose NAL units are split into ever shorter fragments."""
    for nal in re.split(rb"\x00{2,3}\x01", access_unit)[1:]:
        begin, length = 1, 200
        while begin < len(nal):
            flags = (begin == 1) << 7 | (begin + length >= len(nal)) << 6
            yield bytes([nal[0] & 0xE0 | 28, flags | nal[0] & 0x1F]) + nal[begin : begin + length]
            begin, length = begin + length, max(length - 1, 20)

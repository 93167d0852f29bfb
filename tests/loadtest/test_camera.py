"""What is shown: a broadcast of frames at their moments, none left out for a slow reader; objects and their truth."""

import threading
import time
import urllib.error
import urllib.request
from itertools import combinations

import numpy as np
import pytest

from catstream.errors import VideoError
from catstream.loadtest import camera, crowd
from catstream.loadtest.camera import Broadcast, Schedule
from catstream.loadtest.rtsp import due_time, encode
from catstream.video.frames import jpeg
from catstream.video.source import open_source

SIZE = (64, 48)
GREYS = [jpeg(np.full((48, 64, 3), grey, np.uint8)) for grey in (0, 80, 160, 240)]


@pytest.fixture
def broadcast():
    with Broadcast(GREYS, SIZE, streams=2) as camera:
        yield camera


def shown(image: np.ndarray) -> int:
    return round(image.mean() / 80)


def test_the_time_stamp_of_a_frame_is_its_due_time_and_its_image_the_scheduled_one(broadcast):
    schedules = broadcast.play(Schedule(time.monotonic() + 1, 20.0, frames=30))
    for url, schedule in zip(broadcast.urls, schedules, strict=True):
        with open_source(url) as source:
            for frame in source:
                number = schedule.number(frame.pts)
                assert frame.pts == pytest.approx(schedule.due(number), abs=2e-6)
                assert shown(frame.image) == schedule.picture(number, len(GREYS))
                if number >= 10:
                    break
        assert time.monotonic() >= frame.pts


@pytest.mark.parametrize("ahead", [0, 47_719, 10**6])  # an RTP time stamp has 32 bits and begins again after 47,721 s
def test_the_same_is_true_of_h264_over_rtsp(monkeypatch, ahead):
    begin = time.monotonic() - ahead
    monkeypatch.setattr(camera, "monotonic", lambda: time.monotonic() - begin)
    files, numbers = encode(GREYS, SIZE, lambda _: None), []
    with Broadcast(files, SIZE, source="h264") as broadcast:
        (schedule,) = broadcast.play(Schedule(camera.monotonic() + 1.3, 20.0, frames=30))
        with open_source(*broadcast.urls) as source:
            for frame in source:
                if frame.pts is not None:
                    pts = due_time(frame.pts, camera.monotonic())
                    numbers.append(schedule.number(pts))
                    assert pts == pytest.approx(schedule.due(numbers[-1]), abs=1e-4)
                    assert shown(frame.image) == schedule.picture(numbers[-1], len(GREYS))
                    if numbers[-1] >= 15:
                        break
    assert numbers[0] < 0, "it begins with the still"


def test_h264_without_an_encoder_is_an_error(monkeypatch):
    monkeypatch.setattr("av.codecs_available", set())
    with pytest.raises(VideoError, match="PyAV lacks"):
        encode(GREYS, SIZE, lambda _: None)


def test_the_streams_are_shifted_by_a_part_of_a_frame(broadcast):
    one, other = broadcast.play(Schedule(100.0, 20.0, frames=30))
    assert (one.start, other.start) == (100.0, 100.025)


def test_a_still_image_is_sent_before_the_start_and_after_the_end(broadcast):
    (schedule, _) = broadcast.play(Schedule(time.monotonic() + 0.5, 40.0, frames=3))
    seen = {}
    with open_source(broadcast.urls[0]) as source:
        for frame in source:
            seen[schedule.number(frame.pts)] = shown(frame.image)
            if schedule.number(frame.pts) > 20:
                break
    assert {picture for number, picture in seen.items() if number < 0} == {0}
    assert {picture for number, picture in seen.items() if number > 2} == {2}


def test_a_slow_receiver_gets_every_frame(broadcast):
    (schedule, _) = broadcast.play(Schedule(time.monotonic(), 100.0, frames=1000))
    with urllib.request.urlopen(broadcast.urls[0]) as answer:
        first = time.monotonic()
        while time.monotonic() < first + 0.3:
            pass  # it reads nothing: what is sent meanwhile waits
        data = b""
        while schedule.following(time.monotonic()) < 60:
            data += answer.read1()
    assert data.count(b"\xff\xd8\xff") >= 40


def test_a_receiver_that_disconnects_ends_its_connection_only(broadcast, until, capfd):
    broadcast.play(Schedule(time.monotonic(), 100.0, frames=1000))
    before = threading.active_count()
    for _ in range(2):
        with open_source(broadcast.urls[0]) as source:
            assert next(iter(source)).image.shape == (48, 64, 3)
    until(lambda: threading.active_count() <= before)
    assert capfd.readouterr().err == ""


def test_an_unknown_stream_is_an_http_404(broadcast):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(broadcast.urls[0][:-1] + "7")


def test_the_same_arguments_give_the_same_pixels():
    for (image, boxes), (again, same) in zip(crowd.render(3, 4), crowd.render(3, 4), strict=True):
        assert np.array_equal(image, again)
        assert boxes == same


@pytest.mark.parametrize("count", [2, 8, 16])
def test_all_objects_begin_whole_in_the_picture_and_apart(count):
    _, boxes = next(crowd.render(count, 2))
    assert list(boxes) == list(crowd.NAMES[:count])
    for box in boxes.values():
        assert 0 <= box.x <= box.x + box.w <= crowd.SIZE[0]
        assert 0 <= box.y <= box.y + box.h <= crowd.SIZE[1]
    assert all(a.overlap(b) == 0 for a, b in combinations(boxes.values(), 2))


def test_some_objects_leave_and_come_back():
    seen = [boxes["carla"] is not None for _, boxes in crowd.render(3, 60)]
    assert seen[0]
    assert seen[-1]
    assert not all(seen)

"""Previews: small pictures of the newest frame, encoded for subscribers only."""

import cv2
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.client.attach import subscribe
from catstream.processes.outputs import Previews
from catstream.video.frames import Frame
from catstream.video.rendered import render


@pytest.fixture
def previews(endpoint):
    with Previews(endpoint) as previews:
        yield previews


@pytest.fixture
def looks(endpoint, previews, until):
    """A function that subscribes to the previews."""

    def begin():
        reader = subscribe(str(endpoint), "previews", timeout=500)
        until(lambda: previews.has_subscribers, previews.serve)
        return reader

    return begin


def test_preview_shows_the_frame_small_with_its_size(previews, looks):
    ((image, _),) = render(1, (1280, 720))
    with looks() as reader:
        previews.show(7, Frame(9, 0.4, image), {"anna": Box(5.0, 6.0, 70.0, 80.0)})
        preview = next(reader)
    assert (preview.frame, preview.time, preview.width, preview.height) == (7, 0.4, 1280, 720)
    assert preview.boxes == {"anna": Box(5.0, 6.0, 70.0, 80.0)}
    shown = cv2.imdecode(np.frombuffer(preview.jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert cv2.PSNR(shown, cv2.resize(image, (640, 360), interpolation=cv2.INTER_AREA)) > 28


def test_preview_is_not_encoded_without_subscribers(previews, monkeypatch):
    monkeypatch.setattr("catstream.processes.outputs.jpeg", None)  # to call it is an error
    for frame in range(5):
        previews.show(frame, Frame(frame, frame / 25, np.zeros((48, 64, 3), np.uint8)), {})


def test_previews_continue_while_no_object_is_tracked(previews, looks, monkeypatch):
    now = [1.0]
    monkeypatch.setattr("catstream.processes.outputs.monotonic", lambda: now[0])
    with looks() as reader:
        for grey in (0, 255):
            previews.show(3, Frame(grey, 0.4, np.full((48, 64, 3), grey, np.uint8)), {})
            now[0] += 0.06  # the second one is due 0.1 s after the first
            previews.serve()
            jpeg = np.frombuffer(next(reader).jpeg, np.uint8)
            assert np.median(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)) == grey


def test_frames_are_stored_for_five_seconds_for_subscribers(endpoint, until, monkeypatch):
    monkeypatch.setattr("catstream.processes.outputs._PREVIEW_SECONDS", 0.0)
    with Previews(endpoint, stores=True) as previews:
        with subscribe(str(endpoint), "previews", timeout=500):
            until(lambda: previews.has_subscribers, previews.serve)
            for number in range(80):
                previews.show(3, Frame(number, number / 10, np.zeros((48, 64, 3), np.uint8)), {})
            assert [frame.number for frame in previews.since(3.0)] == list(range(30, 80))
            assert [previews.since(time) for time in (2.8, 3.05, 9.0)] == [[]] * 3
            monkeypatch.setattr("catstream.processes.outputs._STORED_BYTES", 3 * 48 * 64 * 3)
            previews.show(3, Frame(80, 8.0, np.zeros((48, 64, 3), np.uint8)), {})
            assert [frame.number for frame in previews.since(7.8)] == [78, 79, 80]
        until(lambda: not previews.since(7.8), previews.serve)

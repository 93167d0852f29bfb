"""Pictures for those who look: small, of the newest frame, and none where nobody looks."""

from contextlib import suppress

import cv2
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.client.attach import subscribe
from catstream.errors import SilenceError
from catstream.processes.outputs import Previews
from catstream.video.frames import Frame
from catstream.video.rendered import render


@pytest.fixture
def previews(endpoint):
    with Previews(endpoint) as previews:
        yield previews


@pytest.fixture
def looks(endpoint, previews, until):
    """Somebody begins to look."""

    def begin():
        reader = subscribe(str(endpoint), "previews", timeout=500)
        until(lambda: previews.has_subscribers, previews.turn)
        return reader

    return begin


def test_a_preview_shows_the_frame_small_and_contains_its_size(previews, looks):
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


def test_previews_continue_while_no_object_is_tracked(previews, looks, until):
    seen = []
    with looks() as reader:
        reader.timeout = 0
        for grey in (0, 255):
            previews.show(3, Frame(grey, 0.4, np.full((48, 64, 3), grey, np.uint8)), {})
            until(lambda: seen.extend(_here(reader)) or any(_grey(preview) == grey for preview in seen), previews.turn)  # noqa: B023
    assert [_grey(preview) for preview in seen] == [0, 255]


def test_frames_of_previews_are_kept_for_five_seconds_while_there_are_subscribers(endpoint, until, monkeypatch):
    monkeypatch.setattr("catstream.processes.outputs._PREVIEW_SECONDS", 0.0)
    with Previews(endpoint, stores=True) as previews:
        with subscribe(str(endpoint), "previews", timeout=500):
            until(lambda: previews.has_subscribers, previews.turn)
            for number in range(80):
                previews.show(3, Frame(number, number / 10, np.zeros((48, 64, 3), np.uint8)), {})
            assert [frame.number for frame in previews.since(3.0)] == list(range(30, 80))
            assert [previews.since(time) for time in (2.8, 3.05, 9.0)] == [[]] * 3
            monkeypatch.setattr("catstream.processes.outputs._STORED_BYTES", 3 * 48 * 64 * 3)
            previews.show(3, Frame(80, 8.0, np.zeros((48, 64, 3), np.uint8)), {})
            assert [frame.number for frame in previews.since(7.8)] == [78, 79, 80]
        until(lambda: not previews.since(7.8), previews.turn)


def _grey(preview):
    return int(np.median(cv2.imdecode(np.frombuffer(preview.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)))


def _here(reader):
    """What has come already."""
    with suppress(SilenceError):
        yield from reader

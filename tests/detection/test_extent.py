"""Size and aspect ratio of the window: which wrong ones are learned from, and how they are followed."""

import cv2
import numpy as np
import pytest

from catstream.base.box import Box, Window
from catstream.detection import extent
from catstream.tracker import Tracker

WINDOW = Window(60, 50, 48, 40)


@pytest.fixture
def draw(texture):
    """A function that draws a textured thing of some width and height over a textured background."""
    background, thing = texture(240, 320, 20), texture(120, 120, 20)

    def frame(w, h):
        image = background.copy()
        x, y = 160 - w // 2, 120 - h // 2
        image[y : y + h, x : x + w] = cv2.resize(thing, (w, h), interpolation=cv2.INTER_AREA)
        return image, Box(x, y, w, h)

    return frame


@pytest.mark.parametrize(("w", "h"), [(84, 60), (60, 84), (84, 84)], ids=["wider", "higher", "larger"])
def test_box_adapts_to_an_object_that_gets(draw, w, h, monkeypatch):
    monkeypatch.setattr(extent, "_PRIOR", 0.0)
    tracker, frames = Tracker(), 80
    tracker.init(*draw(60, 60))
    for share in np.linspace(0, 1, frames):
        image, truth = draw(round(60 + share * (w - 60)), round(60 + share * (h - 60)))
        tracker.update(image)
    assert tracker.track.box.overlap(truth) > 0.8
    assert Box(0, 0, 60, 60).centred(*truth.centre).overlap(truth) < 0.75, "had it stayed"


def test_box_keeps_its_size_in_a_still_frame(draw):
    tracker, (image, truth) = Tracker(), draw(60, 60)
    tracker.init(image, truth)
    for _ in range(8):
        _, box = tracker.update(image)
    assert box.area == pytest.approx(truth.area, rel=0.04)


def test_low_belief_moves_the_box_without_a_new_size():
    near, elsewhere = (WINDOW.scaled(factor).centred(90, 80) for factor in (1.1, 1.5))
    assert extent.smooth(WINDOW, near, resize=False) == pytest.approx(WINDOW.centred(90, 80))
    assert extent.smooth(WINDOW, elsewhere, resize=False) == elsewhere

"""Size and aspect ratio of the window: which wrong ones are learned from, and how they are followed."""

import cv2
import numpy as np
import pytest

from catstream.base.box import Box, Window
from catstream.base.settings import Settings
from catstream.detection import extent, teacher
from catstream.features.cells import Cells
from catstream.features.layout import WINDOW as WINDOW_CELLS
from catstream.features.pyramid import Pyramid
from catstream.messages.heads import ASPECT, EXTENT, HEADS, SIZE
from catstream.numerics import ridge
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
def test_the_box_follows_an_object_that_gets(draw, w, h, monkeypatch):
    monkeypatch.setattr(extent, "_PRIOR", 0.0)
    tracker, frames = Tracker(), 80
    tracker.init(*draw(60, 60))
    for share in np.linspace(0, 1, frames):
        image, truth = draw(round(60 + share * (w - 60)), round(60 + share * (h - 60)))
        tracker.update(image)
    assert tracker.track.box.overlap(truth) > 0.8
    assert Box(0, 0, 60, 60).centred(*truth.centre).overlap(truth) < 0.75, "had it stayed"


def test_in_a_frame_that_does_not_change_the_box_keeps_its_size(draw):
    tracker, (image, truth) = Tracker(), draw(60, 60)
    tracker.init(image, truth)
    for _ in range(8):
        _, box = tracker.update(image)
    assert box.area == pytest.approx(truth.area, rel=0.04)


@pytest.mark.parametrize("steps", [-2, -1, 1, 2])
def test_the_heads_predict_by_how_many_steps_a_window_is_too_large_or_too_wide(draw, steps):
    image, box = draw(60, 60)
    frame, window = Pyramid(image), Window.around(box)
    _, training = teacher.first_training(frame, window, np.random.default_rng(0), Settings())
    rows = training[EXTENT]
    regression = ridge.Regression(np.column_stack([rows.rows, np.ones(len(rows), np.float32)]))
    for head, wrong in ((SIZE, window.scaled(extent.size(steps))), (ASPECT, window.scaled(*extent.stretch(steps)))):
        weights, bias = regression.fit(rows.offsets[:, int(head == ASPECT)], HEADS[head].penalty)
        row = Cells.within(frame.around(wrong, WINDOW_CELLS)).row(0, 0)
        assert (row @ weights + bias - 0.5) * 16 == pytest.approx(steps, abs=0.7)


def test_if_the_belief_is_low_only_the_place_is_followed_unless_the_window_is_redetected():
    near, elsewhere = (WINDOW.scaled(factor).centred(90, 80) for factor in (1.1, 1.5))
    assert extent.smooth(WINDOW, near, resize=False) == pytest.approx(WINDOW.centred(90, 80))
    assert extent.smooth(WINDOW, elsewhere, resize=False) == elsewhere

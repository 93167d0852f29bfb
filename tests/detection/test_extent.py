"""Size and aspect ratio of the window: which wrong ones are learned from, and how they are followed."""

import cv2
import numpy as np
import pytest

from catstream.box import Box, Window
from catstream.detection import extent
from catstream.settings import ExtentSettings, Settings
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
def test_the_box_follows_an_object_that_gets(draw, w, h):
    tracker, frames = Tracker(Settings(extent={"prior": 0})), 80
    tracker.init(*draw(60, 60))
    for share in np.linspace(0, 1, frames):
        image, truth = draw(round(60 + share * (w - 60)), round(60 + share * (h - 60)))
        tracker.update(image)
    assert tracker.track.box.overlap(truth) > 0.8
    assert Box(0, 0, 60, 60).centred(*truth.centre).overlap(truth) < 0.75, "had it stayed"


def test_trials_are_windows_of_wrong_sizes_and_then_of_wrong_aspect_ratios():
    trials = extent.trials(WINDOW, ExtentSettings(size_count=5, aspect_count=3))
    assert [steps for steps, _ in trials] == [-2, -1, 1, 2, -1, 1]
    sizes, aspects = trials[:4], trials[4:]
    for steps, window in sizes:
        assert window.w / window.h == pytest.approx(WINDOW.w / WINDOW.h)
        assert window.w / WINDOW.w == pytest.approx(1.04**steps)
    for steps, window in aspects:
        assert window.area == pytest.approx(WINDOW.area)
        assert window.w / window.h == pytest.approx(WINDOW.w / WINDOW.h * 1.08**steps)


def test_without_a_weight_of_the_extent_head_there_are_no_trials():
    assert extent.trials(WINDOW, ExtentSettings(weight=0)) == []


def test_a_window_follows_by_its_rates():
    found = WINDOW.scaled(1.1).scaled(1.05, 1 / 1.05).centred(90, 80)
    window = extent.followed(WINDOW, found, True)
    assert window.centre == pytest.approx((90, 80))
    assert window.area == pytest.approx(WINDOW.area * 1.1 ** (2 * 0.7))
    assert window.w / window.h == pytest.approx(WINDOW.w / WINDOW.h * 1.05 ** (2 * 0.2))


def test_if_the_belief_is_low_only_the_place_is_followed():
    found = WINDOW.scaled(1.1).centred(90, 80)
    assert extent.followed(WINDOW, found, False) == pytest.approx(WINDOW.centred(90, 80))


def test_a_far_larger_change_is_a_redetection_and_used_unchanged():
    found = WINDOW.scaled(1.5).centred(90, 80)
    assert extent.followed(WINDOW, found, False) == found

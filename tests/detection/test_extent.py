"""Size and aspect of the box: what a frame teaches of them, and how they are followed."""

import cv2
import numpy as np
import pytest

from catstream.box import Box
from catstream.detection import extent, windows
from catstream.detection.search import Found
from catstream.features.hog import WINDOW
from catstream.features.pyramid import Pyramid
from catstream.settings import Settings
from catstream.tracker import Tracker

BOX = Box(60, 50, 48, 40)


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
    assert BOX.scaled(60 / BOX.w, 60 / BOX.h).centred(*truth.centre).overlap(truth) < 0.75, "had it stayed"


def test_a_cut_fits_the_less_the_further_it_is_off(draw):
    settings = Settings(extent={"size_count": 5, "aspect_count": 3})
    image, box = draw(48, 40)
    frame = Pyramid(image)
    own = windows.around(frame, box, WINDOW)[0].row(0, 0)
    rows, fits = extent.cuts(frame, box, own, settings)
    assert rows[0] is own
    assert fits == pytest.approx([1, *np.exp([-2, -0.5, -0.5, -2]), *np.exp([-0.5, -0.5])])
    assert all(np.abs(row - own).max() > 0.01 for row in rows[1:])


def test_where_extent_is_not_learned_nothing_is_cut(draw):
    image, box = draw(48, 40)
    assert extent.cuts(Pyramid(image), box, np.empty(0), Settings(extent={"weight": 0})) == ([], [])


def test_a_box_follows_by_its_rates():
    settings = Settings(extent={"size_rate": 0.5, "aspect_rate": 0.25})
    box = extent.followed(BOX, Found(0.9, BOX.scaled(1.1).scaled(1.05, 1 / 1.05).centred(90, 80)), settings)
    assert box.centre == pytest.approx((90, 80))
    assert box.area == pytest.approx(BOX.area * 1.1)
    assert box.w / box.h == pytest.approx(BOX.w / BOX.h * 1.05 ** (2 * 0.25))


def test_where_the_score_is_low_only_the_place_is_followed():
    found = Found(0.4, BOX.scaled(1.1).centred(90, 80))
    assert extent.followed(BOX, found, Settings(belief={"extent_score": 0.5})) == pytest.approx(BOX.centred(90, 80))


def test_a_far_larger_change_is_another_place_and_taken_over_whole():
    found = Found(0.4, BOX.scaled(1.5).centred(90, 80))
    assert extent.followed(BOX, found, Settings()) == found.box

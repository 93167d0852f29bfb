"""Colour centroid: a window that leaves the object's colours behind is shifted back to them, and no other."""

import numpy as np
import pytest

from catstream.box import Window
from catstream.detection.colour_centroid import recentred
from catstream.features import colours
from catstream.features.layout import COLOURS, row_length
from catstream.features.pyramid import Pyramid, planes_of
from catstream.features.score_map import ScoreMap
from catstream.messages.kinds import Model

RED, GREEN = (40, 40, 200), (60, 160, 60)
SLACK = 0.14


@pytest.fixture
def model():
    """Red has a positive weight, green a negative one."""
    weights = np.zeros(row_length(), np.float32)
    red, green = (colours.shades(planes_of(np.full((2, 2, 3), colour, np.uint8)))[0, 0] for colour in (RED, GREEN))
    weights[COLOURS][red], weights[COLOURS][green] = 1, -1
    return Model(1, 0, weights, 0.0)


def meadow(x, y):
    """A red thing of 40 x 40, centred at (x, y)."""
    image = np.full((200, 240, 3), GREEN, np.uint8)
    image[y - 20 : y + 20, x - 20 : x + 20] = RED
    return Pyramid(image)


def shown(known, model, window, frame, times=1, slack=SLACK):
    """What is known after some equal frames, and the window that the last one gives."""
    around = ScoreMap.around(frame, window, 20, model)
    for _ in range(times):
        known, moved = recentred(known, window, around, model.weights[COLOURS], slack)
    return known, moved


GOOD, FRAMES = Window(80, 60, 64, 64), 60


def test_a_window_that_drifted_off_is_shifted_up_to_the_slack(model):
    frame = meadow(112, 92)
    known, window = shown(None, model, GOOD, frame, FRAMES)
    assert window == GOOD
    drifted = GOOD.centred(112 - 14, 92 + 12)  # 14 and 12 of 64 pixels: by 0.22 and 0.19 of the window
    _, shifted = shown(known, model, drifted, frame, FRAMES)
    np.testing.assert_allclose(np.subtract(shifted.centre, (112, 92)), [-SLACK * 64, SLACK * 64], atol=1.5)
    assert shifted[2:] == drifted[2:]


def test_within_the_slack_it_stays_and_one_frame_moves_little(model):
    frame = meadow(112, 92)
    known, _ = shown(None, model, GOOD, frame, FRAMES)
    beside = GOOD.centred(112 - 8, 92)
    known, window = shown(known, model, beside, frame, FRAMES)
    assert window == beside
    far = GOOD.centred(112 - 16, 92)
    assert abs(shown(known, model, far, frame)[1].centre[0] - far.centre[0]) < 1


def test_colours_that_were_off_centre_at_first_may_return_to_the_centre(model):
    frame, aside = meadow(112, 92), Window(80 + 14, 60, 64, 64)
    known, window = shown(None, model, aside, frame, FRAMES)
    assert window == aside
    assert shown(known, model, GOOD, frame, FRAMES)[1] == GOOD


def test_a_background_of_the_same_colour_shifts_nothing(model):
    known, _ = shown(None, model, GOOD, meadow(112, 92), FRAMES)
    meadow_of_red = Pyramid(np.full((200, 240, 3), RED, np.uint8))
    assert shown(known, model, GOOD, meadow_of_red) == (known, GOOD)


@pytest.mark.parametrize("weight", [0.0, 0.1, 0.3, 1 / 3, 0.7, 1.1])
def test_a_mass_that_is_the_same_everywhere_has_no_centroid(weight):
    even = Model(1, 0, np.full(row_length(), weight, np.float32), 0.0)
    assert shown(None, even, GOOD, meadow(112, 92), FRAMES)[1] == GOOD


def test_a_slack_of_a_whole_window_shifts_nothing(model):
    known, _ = shown(None, model, GOOD, meadow(112, 92), FRAMES)
    drifted = GOOD.centred(112 - 20, 92)
    assert shown(known, model, drifted, meadow(112, 92), FRAMES, slack=1)[1] == drifted


def test_at_the_edge_of_the_search_area_nothing_is_learned(model):
    around, edge = ScoreMap.around(meadow(112, 92), GOOD, 20, model), GOOD.centred(60, 92)
    assert recentred(None, edge, around, model.weights[COLOURS], SLACK) == (None, edge)


def test_the_colour_centroid_is_not_changed_in_place(model):
    known, _ = shown(None, model, GOOD, meadow(112, 92), 45)
    before = known.copy()
    shown(known, model, GOOD.centred(94, 92), meadow(112, 92), 3)
    np.testing.assert_array_equal(known, before)


def test_numbers_that_no_frames_gave_do_no_harm(model):
    assert np.isfinite(shown(np.full(6, -1.0), model, GOOD, meadow(112, 92), 3)[1]).all()

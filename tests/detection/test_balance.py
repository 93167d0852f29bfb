"""Balance: a window that leaves the object's colours behind is drawn after them, and no other."""

import numpy as np
import pytest

from catstream.box import Box
from catstream.detection import search
from catstream.detection.balance import Balance
from catstream.features import colours
from catstream.features.cells import COLOURS, row_length
from catstream.features.pyramid import Pyramid
from catstream.messages import Model

RED, GREEN = (40, 40, 200), (60, 160, 60)
SLACK = 0.14


@pytest.fixture
def model():
    """Red speaks for the object, green against it."""
    weights = np.zeros(row_length(), np.float32)
    red, green = (colours.shades(np.full((2, 2, 3), colour, np.uint8))[0, 0] for colour in (RED, GREEN))
    weights[COLOURS][red], weights[COLOURS][green] = 1, -1
    return Model(1, 0, weights, 0.0)


def meadow(x, y):
    """A red thing of 40 x 40, centred at (x, y)."""
    image = np.full((200, 240, 3), GREEN, np.uint8)
    image[y - 20 : y + 20, x - 20 : x + 20] = RED
    return Pyramid(image)


def shown(balance, model, box, frame, times=1, slack=SLACK):
    around = search.scored_around(frame, box, 20, model)
    for _ in range(times):
        drawn = balance.drawn(box, around, model.weights[COLOURS], slack)
    return drawn


def test_a_window_that_crept_off_is_drawn_up_to_the_slack(model):
    balance, good = Balance(), Box(80, 60, 64, 64)
    frame = meadow(112, 92)
    assert shown(balance, model, good, frame, times=60) == good
    crept = good.centred(112 - 14, 92 + 12)  # 14 and 12 of 64 pixels: by 0.22 and 0.19 of the window
    drawn = shown(balance, model, crept, frame, times=60)
    np.testing.assert_allclose(np.subtract(drawn.centre, (112, 92)), [-SLACK * 64, SLACK * 64], atol=1.5)
    assert drawn[2:] == crept[2:]


def test_within_the_slack_it_stays_and_one_frame_moves_little(model):
    balance, good = Balance(), Box(80, 60, 64, 64)
    frame = meadow(112, 92)
    shown(balance, model, good, frame, times=60)
    beside = good.centred(112 - 8, 92)
    assert shown(balance, model, beside, frame, times=60) == beside
    far = good.centred(112 - 16, 92)
    assert abs(shown(balance, model, far, frame).centre[0] - far.centre[0]) < 1


def test_colours_that_lay_to_one_side_at_first_may_come_back_to_the_middle(model):
    balance, frame = Balance(), meadow(112, 92)
    aside = Box(80 + 14, 60, 64, 64)
    assert shown(balance, model, aside, frame, times=60) == aside
    middle = Box(80, 60, 64, 64)
    assert shown(balance, model, middle, frame, times=60) == middle


def test_a_background_of_the_same_colour_draws_nothing(model):
    balance, good = Balance(), Box(80, 60, 64, 64)
    shown(balance, model, good, meadow(112, 92), times=60)
    meadow_of_red = Pyramid(np.full((200, 240, 3), RED, np.uint8))
    before = balance.state.copy()
    assert shown(balance, model, good, meadow_of_red) == good
    np.testing.assert_array_equal(balance.state, before)


@pytest.mark.parametrize("weight", [0.0, 0.1, 0.3, 1 / 3, 0.7, 1.1])
def test_a_mass_that_is_the_same_everywhere_has_no_centre(weight):
    balance, box = Balance(), Box(80, 60, 64, 64)
    even = Model(1, 0, np.full(row_length(), weight, np.float32), 0.0)
    assert shown(balance, even, box, meadow(112, 92), times=60) == box


def test_a_slack_of_a_whole_window_draws_nothing(model):
    balance, good = Balance(), Box(80, 60, 64, 64)
    shown(balance, model, good, meadow(112, 92), times=60)
    crept = good.centred(112 - 20, 92)
    assert shown(balance, model, crept, meadow(112, 92), times=60, slack=1) == crept


def test_at_the_edge_of_what_was_searched_nothing_is_taken_in(model):
    balance, box = Balance(), Box(80, 60, 64, 64)
    around = search.scored_around(meadow(112, 92), box, 20, model)
    assert balance.drawn(box.centred(60, 92), around, model.weights[COLOURS], SLACK) == box.centred(60, 92)
    assert not balance.state.any()


def test_another_one_goes_on_bit_for_bit(model):
    balance, good, frame = Balance(), Box(80, 60, 64, 64), meadow(112, 92)
    shown(balance, model, good, frame, times=45)
    other = Balance.resumed(balance.state)
    crept = good.centred(94, 92)
    assert shown(other, model, crept, frame, 30) == shown(balance, model, crept, frame, 30)
    np.testing.assert_array_equal(other.state, balance.state)


def test_a_state_that_no_balance_had_does_no_harm(model):
    other = Balance.resumed(np.full(6, -1.0))
    assert np.isfinite(shown(other, model, Box(80, 60, 64, 64), meadow(112, 92), 3)).all()

"""The colours of objects: they can be told apart, and stay."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from catstream.applications.html.page import COLOURS
from catstream.video.palette import PALETTE, Colours, rgb

#: Linear red, green, blue as people of each kind of vision see them (Machado and others, 2009, severity 1).
VISIONS = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
#: Linear red, green, blue to the responses of the cones, and their cube roots to lightness and two axes of colour.
CONES = [[0.4122, 0.5363, 0.0514], [0.2119, 0.6807, 0.1074], [0.0883, 0.2817, 0.6300]]
OKLAB = [[0.2105, 0.7936, -0.0041], [1.9780, -2.4286, 0.4506], [0.0259, 0.7828, -0.8087]]


def linear(colour):
    share = np.array(rgb(colour)) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def oklab(colour, vision):
    return np.array(OKLAB) @ np.cbrt(np.array(CONES) @ np.clip(np.array(vision) @ linear(colour), 0, 1))


@pytest.mark.parametrize(
    ("colours", "kinds", "apart"),
    [(PALETTE, VISIONS.keys(), 0.09), (COLOURS, VISIONS.keys() - {"tritanopia"}, 0.1)],
    ids=["objects", "curves"],
)
def test_any_two_colours_are_distinguishable_also_for_colour_blind_people(colours, kinds, apart):
    # The eight colours of Okabe and Ito are 0.02 to 0.12 apart in the same measure.
    for kind in kinds:
        seen = [oklab(colour, VISIONS[kind]) for colour in colours]
        assert min(np.linalg.norm(one - other) for one, other in combinations(seen, 2)) > apart, kind


@pytest.mark.parametrize("colour", PALETTE)
def test_dark_text_on_a_colour_is_readable(colour):
    luminance, dark = np.dot([0.2126, 0.7152, 0.0722], linear(colour)), 0.0056  # of #111
    assert (luminance + 0.05) / (dark + 0.05) >= 4.5


@given(some.lists(some.tuples(some.booleans(), some.sampled_from("abcdefghijkl"))))
def test_a_colour_stays_while_its_object_lives_and_is_shared_only_if_all_are_used(events):
    colours, living = Colours(), {}
    for comes, name in events:
        if comes:
            before = living.setdefault(name, colours.of(name))
            assert colours.of(name) == before
        else:
            living.pop(name, None)
            colours.keep(living)
        assert {name: colours.of(name) for name in living} == living


@given(some.sets(some.text(), max_size=len(PALETTE)))
def test_as_many_objects_as_colours_have_different_ones(names):
    colours = Colours()
    assert len({colours.of(name) for name in names}) == len(names)

"""The starts of the runs: their frames, and boxes that tracking can begin with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.applications.evaluation.datasets import (
    FIRST,
    SHIFTS,
    Sequence,
    Start,
    choose_starts,
    jittered,
    one_pass,
    spatial,
    temporal,
)
from catstream.applications.evaluation.onepass import evaluate
from catstream.box import Box
from catstream.errors import CatstreamError
from catstream.settings import Settings


def boxes_of(starts: list[Start], sequence: Sequence) -> np.ndarray:
    return np.array([start.box(sequence) for start in starts])


def test_start_frames_are_evenly_spaced_over_the_frames_with_the_object(sequence):
    def frames(count: int) -> list[int]:
        return [start.frame for start in temporal(count)(sequence)]

    assert frames(1) == [0]
    assert frames(2) == [0, 8]  # the object is absent in 5, 6 and 7
    assert frames(4) == [0, 3, 8, 9]
    assert frames(12) == [0, 1, 2, 3, 4, 8, 9, 10]  # after the last one with the object, there is nothing to measure


@pytest.mark.parametrize("box", [(-40, 50, 60, 30), (140, 50, 60, 30), (60, 50, 30, 1), (-99, 0, 330, 90)])
def test_a_start_frame_whose_box_tracking_cannot_start_with_is_not_used(sequence, box):
    boxes = sequence.boxes.copy()
    boxes[[0, 3]] = box
    frames = [start.frame for start in temporal(4)(replace(sequence, boxes=boxes))]
    assert frames == [1, 4, 8, 9]


def test_if_no_frame_has_a_valid_box_or_can_be_read_the_run_says_so(sequence, tmp_path):
    outside = replace(sequence, boxes=np.tile([-90.0, 0, 60, 60], (12, 1)))
    unreadable = replace(sequence, path=tmp_path)
    errors: list[CatstreamError] = []
    assert evaluate([outside], ["mil"], Settings(), starts=temporal(2), failed=errors.append) == []
    assert evaluate([unreadable], ["mil"], Settings(), starts=temporal(2), failed=errors.append) == []
    assert [str(error).split(": ")[0] for error in errors] == [
        "mil on walk",
        "mil on walk@6",
        "mil on walk",
        "mil on walk@8",
    ]


def test_every_choice_starts_when_the_object_appears(sequence):
    late = Sequence("late", sequence.path, np.vstack([np.full((3, 4), np.nan), sequence.boxes]))
    for starts in (one_pass, temporal(1), spatial, jittered(3)):
        assert {start.frame for start in starts(late)} == {3}
    assert {start.suffix for start in spatial(late)} > {"@3-left", "@3-size-0.8"}


def test_each_option_of_the_command_chooses_its_starts(sequence):
    assert choose_starts()(sequence) == [FIRST]
    starts = {*temporal(4)(sequence), *spatial(sequence), *jittered(7)(sequence)}
    assert len({start.suffix for start in starts}) == len(starts) == 4 + 12 + 6  # each has a name of its own
    assert choose_starts(2)(sequence) == temporal(2)(sequence)
    assert choose_starts(boxes=2)(sequence) == jittered(2)(sequence)
    assert choose_starts(shifts=True)(sequence) == spatial(sequence)


def test_the_shifts_are_those_of_the_cvpr2013_benchmark(sequence):
    x, y, w, h = sequence.boxes[0]
    found = boxes_of(spatial(sequence), sequence)
    np.testing.assert_allclose(found[:8, 2:], [(w, h)] * 8)
    centres = found[:, :2] + found[:, 2:] / 2 - (x + w / 2, y + h / 2)
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)]
    np.testing.assert_allclose(centres, np.vstack([np.array(moves) * (0.1 * w, 0.1 * h), np.zeros((4, 2))]), atol=1e-9)
    np.testing.assert_allclose(found[8:, 2:], np.outer([0.8, 0.9, 1.1, 1.2], (w, h)))


def test_jittered_boxes_are_the_given_one_and_fixed_random_ones_within_two_percent(sequence):
    x, y, w, h = sequence.boxes[0]
    found = boxes_of(jittered(5)(sequence), sequence)
    assert found[0].tolist() == [x, y, w, h]
    for k in range(1, 5):
        dx, dy, dw, dh = np.random.default_rng(k).uniform(-0.02, 0.02, 4)
        wide, high = w * (1 + dw), h * (1 + dh)
        np.testing.assert_allclose(found[k], (x + w / 2 + dx * w - wide / 2, y + h / 2 + dy * h - high / 2, wide, high))


@given(st.tuples(st.floats(0, 159.9), st.floats(0, 119.9)), st.tuples(st.floats(2, 320), st.floats(2, 240)), st.data())
def test_tracking_can_start_with_every_changed_box(centre, sides, data):
    truth = Box(0, 0, *sides).centred(*centre)
    sequence = Sequence("walk", None, np.array([truth]))
    start = Start(
        0, data.draw(st.sampled_from([start.variation for start in jittered(4)(sequence)[1:]] + list(SHIFTS)))
    )
    box = start.box(sequence, (160, 120))
    assert box.validated(160, 120) is box


@pytest.mark.parametrize("variation", SHIFTS, ids=lambda variation: variation.name)
def test_a_changed_box_in_the_middle_of_the_frame_is_not_moved(sequence, variation):
    start = Start(0, variation)
    np.testing.assert_allclose(start.box(sequence, (1000, 1000)), start.box(sequence), atol=1e-9)

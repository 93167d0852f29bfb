"""Fusion of passes: which box wins, and how probable it is that it is right."""

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.offline.fusion import fuse
from catstream.offline.passes import Pass, iou

LEFT, RIGHT = Box(10, 20, 30, 40), Box(110, 20, 30, 40)
ABSENT = [np.nan] * 4


def forward(*boxes, score=0.9):
    """A pass from keyframe 0 to keyframe 10 with the last of some boxes from some frame on."""
    return Pass(0, 10, np.array(boxes * 10 if len(boxes) == 1 else boxes, float), np.full(10, score))


def backward(*boxes, score=0.9):
    return Pass(10, 0, np.array(boxes * 10 if len(boxes) == 1 else boxes, float), np.full(10, score))


def fused(*passes, drawn):
    return fuse(passes, 1, 10, drawn)


@pytest.mark.parametrize(
    ("passes", "drawn", "box", "certain"),
    [
        ([forward(LEFT), backward(LEFT)], LEFT, LEFT, True),
        ([forward(LEFT)], LEFT, LEFT, False),
        ([backward(LEFT)], LEFT, LEFT, False),
        ([forward(ABSENT), backward(ABSENT)], None, ABSENT, True),
        ([forward(ABSENT), backward(ABSENT)], LEFT, ABSENT, False),
        ([], LEFT, ABSENT, False),
    ],
    ids=["both agree", "forward only", "backward only", "absent", "lost by both", "no pass"],
)
def test_box_is_certain_only_if_both_directions_agree(passes, drawn, box, certain):
    boxes, probabilities, _ = fused(*passes, drawn={0: drawn, 10: drawn})
    assert boxes == pytest.approx(np.array([box] * 9), nan_ok=True)
    assert ((probabilities > 0.97) == certain).all()


def test_nearer_keyframe_wins_if_neither_pass_arrives():
    boxes, probabilities, _ = fused(forward(LEFT), backward(RIGHT), drawn={0: LEFT, 10: RIGHT})
    assert boxes[:, 0].tolist() == [10.0] * 5 + [110.0] * 4
    assert (probabilities.argmin(), probabilities.min() < 0.8) == (4, True)


def test_pass_that_arrives_wins_beyond_the_middle():
    boxes, _, _ = fused(forward(LEFT), backward(RIGHT), drawn={0: LEFT, 10: LEFT})
    assert boxes[:7, 0].tolist() == [10.0] * 7


def test_pass_has_less_weight_while_the_object_is_lost():
    found = forward(*[LEFT] * 2, *[RIGHT] * 4, *[LEFT] * 4)
    boxes, _, _ = fused(found, backward(LEFT), drawn={0: LEFT, 10: LEFT})
    assert boxes[:, 0].tolist() == [10.0] * 9


def test_higher_score_of_one_direction_is_more_probable():
    low, high, highest = (fused(forward(LEFT, score=score), drawn={0: LEFT})[1].max() for score in (0.3, 0.9, 3.0))
    assert low < high < highest < 0.97


def test_frames_next_to_a_disagreement_are_less_probable():
    lost = backward(*[LEFT] * 5, RIGHT, *[LEFT] * 4)  # in frame 4
    probabilities = fused(forward(LEFT), lost, drawn={0: LEFT, 10: LEFT})[1]
    assert probabilities[3] == probabilities.min()
    assert (probabilities < fused(forward(LEFT), backward(LEFT), drawn={0: LEFT, 10: LEFT})[1]).all()


def test_passes_that_agree_are_averaged_by_distance():
    moved = Box(14, 20, 30, 40)
    x = fused(forward(LEFT), backward(moved), drawn={0: LEFT, 10: moved})[0][:, 0]
    assert x == pytest.approx(np.linspace(10.4, 13.6, 9))


def test_order_of_the_passes_does_not_matter():
    passes = [forward(LEFT), backward(RIGHT), backward(LEFT)]
    one, other = (fused(*order, drawn={0: LEFT, 10: LEFT}) for order in (passes, passes[::-1]))
    assert all(np.allclose(*both) for both in zip(one, other, strict=True))


def test_part_of_a_pass_starts_at_a_later_keyframe():
    whole = Pass(0, 10, np.arange(40.0).reshape(10, 4), np.arange(10.0))
    part = whole.part(4, 8, {0: LEFT, 4: Box(*whole.boxes[3]), 10: LEFT})
    assert (part.start, part.stop, part.scores.tolist()) == (4, 8, [4, 5, 6, 7])
    assert (part.boxes == whole.boxes[4:8]).all()
    back = Pass(10, 0, whole.boxes, whole.scores)
    assert back.part(4, 0, {10: LEFT, 4: Box(*back.boxes[5])}).scores.tolist() == [6, 7, 8, 9]
    assert back.part(0, 4, {}) is whole.part(8, 12, {}) is None


def test_pass_that_missed_a_keyframe_has_no_part_after_it():
    assert forward(LEFT).part(4, 8, {0: LEFT, 4: LEFT}) is not None
    assert forward(LEFT).part(4, 8, {0: LEFT, 4: RIGHT}) is None
    assert forward(LEFT).part(4, 8, {0: LEFT, 4: None}) is None
    assert forward(ABSENT).part(4, 8, {0: LEFT, 4: None}) is not None


def test_iou_is_one_if_both_are_absent_and_zero_if_one_is():
    boxes = np.array([LEFT, ABSENT])
    assert iou(boxes, boxes).tolist() == [1, 1]
    assert iou(boxes, boxes[::-1]).tolist() == [0, 0]

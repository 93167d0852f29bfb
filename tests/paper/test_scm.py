"""The sparse collaborative model alone: its sparse codes, and what it follows."""

import itertools
import warnings
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from sklearn.decomposition import sparse_encode

from catstream.box import Box
from catstream.paper import scm
from catstream.paper.scm import SparseCollaborativeModel
from catstream.video import rendered

START = Box(60, 50, 48, 40)


def followed(frames, start, seed=0):
    frames = iter(frames)
    model = SparseCollaborativeModel(next(frames), start, np.random.default_rng(seed), particles=100)
    return [model.follow(frame) for frame in frames]


@pytest.mark.parametrize("centre", [0.0, 1.0])
def test_codes_are_those_of_scikit_learn(rng, centre):
    """Also of atoms that are nearly alike, as patches of a picture are."""
    atoms, rows = (scm._unit(rng.normal(centre, 0.5, size=(count, 36))) for count in (50, 40))
    codes = scm._codes(rows, atoms)
    exact = [array.astype(np.float64) for array in (rows, atoms)]
    expected = sparse_encode(*exact, algorithm="lasso_cd", alpha=scm._PENALTY, positive=True, max_iter=100_000)
    assert codes.min() == 0
    np.testing.assert_allclose(codes, expected, atol=1e-3)


def test_the_demos_object_is_followed():
    frames, truth = zip(*rendered.render(40, (320, 240)), strict=True)
    found = followed(frames, truth[0])
    assert min(found_box.overlap(box) for (_, found_box), box in zip(found, truth[1:], strict=True)) > 0.5


def test_a_half_covered_object_is_tracked(scene):
    ways = [((60 + 2 * i, 50 + i), 0.4 if 4 <= i < 12 else 0.0) for i in range(16)]
    found = followed(itertools.starmap(scene, ways), START)
    overlaps = [box.overlap(Box(*at, 48, 40)) for (_, box), (at, _) in zip(found, ways[1:], strict=True)]
    assert min(overlaps) > 0.5


def test_the_score_falls_if_the_object_is_absent(scene):
    (there, _), (gone, _) = followed([scene((60, 50)), scene((62, 51)), scene((250, 180))], START)
    assert there > 0.6 > 0.5 > gone


def test_warnings_have_the_same_filters_after_several_threads_have_trained(rng):
    cuts = rng.integers(0, 256, (2, 20, 32, 32), np.uint8)
    before = list(warnings.filters)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: scm._Discriminative.trained(*cuts), range(200)))
    assert warnings.filters == before


def test_grey_frames_are_followed_as_those_in_colour(scene):
    frames = [scene((60 + 3 * i, 50 + 2 * i)) for i in range(7)]
    grey = [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in frames]
    assert followed(grey, START) == followed(frames, START)


def test_the_same_seed_gives_the_same_boxes_and_another_others(scene):
    frames = [scene((60 + 3 * i, 50 + 2 * i)) for i in range(7)]
    assert followed(frames, START, seed=1) == followed(frames, START, seed=1) != followed(frames, START, seed=2)


def test_a_frame_without_any_contrast_is_survived():
    ((score, box),) = followed(np.zeros((2, 120, 160), np.uint8), START)
    assert np.isfinite([score, *box]).all()


def test_an_object_that_leaves_stays_a_box_in_the_frame(scene):
    frames = [np.roll(scene((60, 50)), -8 * i, axis=1)[:, :160] for i in range(12)]
    assert all(0 <= box.centre[0] < 160 for _, box in followed(frames, START))

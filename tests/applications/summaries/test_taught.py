"""The frames that taught most: what counts as new, and how they are spread over the run."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from catstream.applications.summaries.sheet import pictures_of
from catstream.applications.summaries.taught import Novelty, TaughtFrame, most_taught, taught_frames
from catstream.compression.tree import REDUCTIONS
from catstream.errors import SettingsError, VideoError
from catstream.messages.heads import APPEARANCE
from catstream.messages.kinds import Features, ObjectFeatures, TrainingRows
from catstream.settings import CoresetSettings

WIDTH, CHANGE = 400, 25


def message(rng, frame, looks, name="", begins=False):
    """Features of a frame in which the object looks like a direction, with a little noise."""
    rows = looks + 0.01 * rng.normal(size=(6, WIDTH))
    training = {APPEARANCE: TrainingRows.labelled(rows, [1, 1, 1, 1, 0, 0.5])}
    return Features(frame + 1, frame, frame / 25, {name: ObjectFeatures(None, training, None, begins)})


@pytest.fixture
def run(rng):
    """A run in which the object changes its looks at one frame, and has the first looks again ten frames later."""
    first, second = np.linalg.qr(rng.normal(size=(WIDTH, 2)))[0].T
    return [message(rng, frame, second if CHANGE <= frame < CHANGE + 10 else first) for frame in range(60)]


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_a_frame_is_new_if_the_object_has_not_looked_so_before(run, reduction):
    frames = taught_frames(run, CoresetSettings(size=8, reduction=reduction))[""]
    novelties = [frame.novelty for frame in frames]
    assert novelties[0] == 1
    assert novelties[CHANGE] > 0.9
    assert max(novelties[1:CHANGE] + novelties[CHANGE + 1 :]) < 0.1


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_novelty_is_the_energy_outside_the_span_of_the_tree(rng, reduction):
    tree, rows = REDUCTIONS[reduction](8), rng.normal(size=(50, WIDTH)).astype(np.float32)
    novelty = Novelty(tree)
    for row in rows[:, None]:
        outside = row
        if tree.rows_seen:
            known = np.vstack([*(node.rows for node in tree.nodes), tree.pending]).astype(np.float64)
            _, lengths, directions = np.linalg.svd(known, full_matrices=False)
            span = directions[lengths > 1e-3 * lengths[0]]
            outside = row - row @ span.T @ span
        assert novelty.of(row) == pytest.approx(np.sum(outside**2) / np.sum(row**2), abs=1e-3)


def test_the_frames_of_an_object_that_is_replaced_are_left_out(run):
    again = [dataclasses.replace(run[40], objects={"": dataclasses.replace(run[40].objects[""], begins=True)})]
    frames = taught_frames(run[:40] + again + run[41:], CoresetSettings(size=8))[""]
    assert [frame.frame for frame in frames] == list(range(40, 60))
    assert frames[0].novelty == 1


def test_each_object_is_measured_by_itself(run, rng):
    alone = taught_frames(run, CoresetSettings(size=8))
    others = [message(rng, frame, rng.normal(size=WIDTH), "other") for frame in range(60)]
    both = [
        dataclasses.replace(one, objects=one.objects | other.objects) for one, other in zip(run, others, strict=True)
    ]
    together = taught_frames(both, CoresetSettings(size=8))
    assert together.keys() == {"", "other"}
    assert together[""] == alone[""]


@given(st.lists(st.floats(0, 1), min_size=1, max_size=60), st.integers(1, 12))
@example([0.9, 0.8, *[0.1] * 18], 2)
def test_k_frames_are_selected_and_spread_over_the_run(novelties, k):
    frames = [TaughtFrame(number, number / 25, None, novelty) for number, novelty in enumerate(novelties)]
    if k > len(frames):
        with pytest.raises(SettingsError, match=f"{k} frames cannot be selected"):
            most_taught(frames, k)
        return
    chosen = [frame.frame for frame in most_taught(frames, k)]
    assert len(chosen) == k
    assert all(later - earlier >= max(len(frames) // (2 * k), 1) for earlier, later in pairwise(chosen))
    assert int(np.argmax(novelties)) in chosen


def test_the_error_of_a_live_source_has_no_password():
    with pytest.raises(VideoError, match=r"^'rtsp://c/d' is a live source"):
        pictures_of([], "rtsp://a:b@c/d", 25.0)

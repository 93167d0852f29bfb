"""Measures: every frame that was due counts once, and nothing gets better by being skipped."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.box import Box
from catstream.measure.latency import PERCENTILES, Observations, latencies_to_answer, measure, percentiles
from catstream.wire.messages import Model

BOX = Box(10.0, 10.0, 20.0, 20.0)
TRUTH = np.array([BOX] * 4 + [[np.nan] * 4])  # the box of each track, then none


def test_latency_of_a_tracked_frame_ends_with_its_own_track(schedule, track):
    observations = Observations(tracks=[track(number, 0.02) for number in range(10)])
    measures = measure(observations, schedule, 10, TRUTH, end=102.0, totals={})
    assert measures.track == pytest.approx(np.full(10, 0.02))
    assert measures.skipped == 0


def test_latency_of_a_skipped_frame_ends_with_a_newer_track(schedule, track):
    observations = Observations(tracks=[track(0, 0.02), track(5, 0.02), track(9, 0.02)])
    measures = measure(observations, schedule, 10, TRUTH, end=102.0, totals={})
    assert measures.track[1:6] == pytest.approx([0.42, 0.32, 0.22, 0.12, 0.02])
    assert measures.skipped == pytest.approx(0.7)
    measures = measure(Observations(tracks=[track(7, 0.02)]), schedule, 10, TRUTH, end=105.0, totals={})
    assert measures.track.max() == pytest.approx(4.2)  # until the end of the run


def test_success_compares_the_last_box_with_each_frame(schedule, track):
    tracks = [track(number, 0.02) for number in (2, 3, 4, 5)]  # frames 5 to 9 show the images again
    wrong = [(moment, replace(track, box=BOX._replace(x=25.0))) for moment, track in [track(6, 0.02)]]
    measures = measure(Observations(tracks=tracks + wrong), schedule, 10, TRUTH, end=102.0, totals={})
    assert measures.success == 3 / 8  # 0 and 1 have no box yet; 7 and 8 have the wrong one of 6


def test_success_repeats_the_last_repetition_of_the_video(schedule, track):
    boxes = np.array([BOX, BOX._replace(x=99.0), BOX, BOX])  # two repetitions of two images
    observations = Observations(tracks=[track(number, 0.02) for number in range(10)])
    assert measure(observations, schedule, 10, boxes, end=102.0, totals={}, images=2).success == 9 / 10


def test_still_frames_outside_a_run_do_not_count(schedule, track):
    observations = Observations(tracks=[track(-3, 0.01), track(4, 0.01), track(12, 0.01)])
    measures = measure(observations, schedule, 10, TRUTH, end=105.0, totals={})
    assert measures.tracked.sum() == 1
    assert measures.track.max() == pytest.approx(0.71)


def test_model_latency_ends_with_the_first_newer_model(schedule, track):
    observations = Observations(tracks=[track(number, 0.02) for number in range(10)])
    observations.models = [(100.45, schedule.due(2)), (100.95, schedule.due(7)), (101.5, schedule.due(9))]
    measures = measure(observations, schedule, 10, TRUTH, end=102.0, totals={})
    assert measures.model == pytest.approx([0.45, 0.35, 0.25, 0.65, 0.55, 0.45, 0.35, 0.25, 0.7, 0.6])


def test_frame_number_reused_after_a_restart_means_the_new_frame(schedule, track):
    observations, model = Observations(), Model(1, 51, np.zeros(2, np.float32), 0.0)
    for moment, message in (track(0, 0.0, frame=50), track(1, 0.0, frame=51), (100.2, model)):
        observations.add(moment, message)
    for moment, message in (track(6, 0.0, frame=51), (100.8, model)):
        observations.add(moment, message)
    assert [newest for _, newest in observations.models] == pytest.approx([schedule.due(1), schedule.due(6)])


@given(st.lists(st.tuples(st.floats(0, 50), st.integers(-5, 30)), max_size=40), st.integers(1, 20))
def test_latencies_equal_those_of_brute_force(answers, frames):
    due = np.arange(frames) / 10
    found = latencies_to_answer(due, answers, end=60.0)
    # What is newer than the last frame covers them all.
    expected = [min([at for at, number in answers if number >= frame], default=60.0) for frame in range(frames)]
    np.testing.assert_allclose(found, np.array(expected) - due)


def test_percentile_is_the_latency_of_a_frame(rng):
    seconds = rng.lognormal(-4, 1, 2_001)
    found = percentiles(seconds)
    for name, percentile in PERCENTILES.items():
        assert found[name] == np.sort(seconds)[int(np.ceil(percentile / 100 * len(seconds))) - 1]
    assert percentiles(np.array([0.25])) == dict.fromkeys(PERCENTILES, 0.25)

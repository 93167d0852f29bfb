"""Sightings that follow one another are an interval."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from catstream.applications.finding.found import FileResult
from catstream.box import Box


def sighting(time, x=0.0, size=40.0, name="anna", score=0.8):
    return Sighting(name, "walk.mp4", round(25 * time), time, Box(x, 50.0, size, size), score)


def test_a_jump_and_a_change_of_size_continue_an_interval_and_a_gap_begins_one():
    result = FileResult("walk.mp4", [], gap_seconds=1.0)
    result.add(0, 0.0, [sighting(0.0)])
    result.add(0, 0.0, [sighting(0.2, x=300.0)])
    result.add(0, 0.0, [sighting(0.4, size=80.0)])
    result.add(0, 0.0, [sighting(1.2)])
    result.add(0, 0.0, [sighting(2.5)])
    assert [interval.count for interval in result.intervals] == [4, 1]


def test_two_sightings_of_one_object_in_a_frame_are_in_one_interval():
    result = FileResult("walk.mp4", [], gap_seconds=1.0)
    for step in range(5):
        result.add(0, 0.0, [sighting(0.2 * step, x=2.0 * step), sighting(0.2 * step, x=60.0 - 2 * step)])
    assert [interval.count for interval in result.intervals] == [10]


times = st.lists(st.floats(0, 30), min_size=1, max_size=40)


@given(st.data(), times)
def test_every_sighting_is_in_one_interval_of_its_object(data, moments):
    result = FileResult("walk.mp4", [], gap_seconds=1.0)
    made = []
    for time in sorted(moments):
        name = data.draw(st.sampled_from(["anna", "ben"]))
        made.append(sighting(time, x=data.draw(st.floats(0, 500)), name=name, score=data.draw(st.floats(0.5, 1))))
        (interval,) = result.add(0, 0.0, [made[-1]])
        assert interval.last is made[-1]
        assert interval.first.object == name
        since = [each for each in made if each.object == name and each.time >= interval.first.time]
        assert interval.best.score == max(each.score for each in since)
    assert sum(interval.count for interval in result.intervals) == len(made)
    assert all(interval.first.time <= interval.best.time <= interval.last.time for interval in result.intervals)
    for name in ("anna", "ben"):
        own = [interval for interval in result.intervals if interval.first.object == name]
        assert all(one.last.time + result.gap_seconds < other.first.time for one, other in pairwise(own))

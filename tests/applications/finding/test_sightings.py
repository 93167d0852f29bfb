"""Sightings that follow one another are an interval."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from catstream.applications.finding.find import Sighting, Step
from catstream.applications.finding.found import FileResult
from catstream.box import Box
from catstream.video.frames import Frame

IMAGE = np.zeros((60, 80, 3), np.uint8)


def sighting(time, x=0.0, size=40.0, name="anna", score=0.8):
    return Sighting(name, "walk.mp4", round(25 * time), time, Box(x, 50.0, size, size), score)


def intervals_of(*steps):
    """The intervals of the sightings of these steps."""
    result = FileResult("walk.mp4", [], gap=1.0)
    for number, step in enumerate(steps):
        result.add(Step(Frame(number, step[0].time, IMAGE), step))
    return result.intervals


def test_a_jump_and_a_change_of_size_continue_an_interval_and_a_gap_begins_one():
    alone = sighting(0.0), sighting(0.2, x=300.0), sighting(0.4, size=80.0), sighting(1.2), sighting(2.5)
    assert [interval.count for interval in intervals_of(*([each] for each in alone))] == [4, 1]


seen = st.tuples(st.floats(0, 30), st.sampled_from(["anna", "ben"]), st.floats(0.5, 1))


@given(st.lists(seen, min_size=1, max_size=40))
def test_every_sighting_is_in_one_interval_of_its_object(facts):
    made = [sighting(time, name=name, score=score) for time, name, score in sorted(facts)]
    found = intervals_of(*([each] for each in made))
    assert sum(interval.count for interval in found) == len(made)
    for name in ("anna", "ben"):
        own = [interval for interval in found if interval.first.object == name]
        assert all(one.last.time + 1.0 < other.first.time for one, other in pairwise(own))
        for each in own:
            within = [one for one in made if one.object == name and each.first.time <= one.time <= each.last.time]
            assert (each.count, each.best.score) == (len(within), max(one.score for one in within))

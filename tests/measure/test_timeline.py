"""The figures over time: a second has the latencies of the frames due in it, and the readings at its end."""

import numpy as np
import pytest

from catstream.measure.latency import REST, Measures, Reading, Receipts
from catstream.measure.load_result import Plan, Result
from catstream.measure.timeline import timeline


def test_each_second_has_the_figures_of_its_frames():
    due = 100 + np.arange(30) / 10
    second = np.arange(30) // 10
    late = [Measures(due + 0.05 * number, second < 2 - number, (1.0 + second) / 100, due * 0, 0.9) for number in (0, 1)]
    receipts = Receipts(1, "tracks", np.stack([late[1].track * 2, late[1].track * 3]), [30, 30], [0, 0])
    cores = [{"detector 0": n / 10, "trainer 1": 0.1, "camera": 0.01, REST: 0.5} for n in range(5)]
    readings = [Reading(99.0 + n, 1.0, cores[n], {"detector 0": n * 1000} if n in (0, 4) else {}) for n in range(5)]
    figures = timeline(Result(Plan(rate=10.0), 3.0, late, readings, [receipts], 0.0))
    assert figures["seconds"] == [0, 1, 2]
    assert figures["p50"] == figures["p99"] == [0.01, 0.02, 0.03]
    assert figures["tracks-p50"] == pytest.approx([0.02, 0.04, 0.06])
    assert figures["tracks-p99"] == pytest.approx([0.03, 0.06, 0.09])
    assert figures["skipped"] == [0, 0.5, 1]
    assert figures["frames_per_second"] == [20, 10, 0]
    assert figures["cores"] == pytest.approx([0.3, 0.4, 0.5])
    assert figures["load_cores"] == pytest.approx([0.01] * 3)
    assert figures["other_cores"] == [0.5] * 3
    assert figures["memory"] == [2000, 3000, 4000]


@pytest.mark.parametrize(
    ("rate", "seconds", "intervals", "length"), [(0.5, 7, 4, 2), (0.7, 9, 4, 2), (1.0, 9000, 3000, 3)]
)
def test_intervals_are_longer_in_a_long_run_or_at_a_low_rate(rate, seconds, intervals, length):
    due = 12345.678 + np.arange(round(rate * seconds)) / rate
    readings = [Reading(due[-1], seconds, {REST: 0.5}, {"detector 0": 1000})]
    streams = [Measures(due, due > 0, due * 0, due * 0, 0.9)]
    figures = timeline(Result(Plan(rate=rate), seconds, streams, readings, [], 0.0))
    assert (len(figures["seconds"]), figures["seconds"][1]) == (intervals, length)
    assert figures["p99"] == [0] * intervals

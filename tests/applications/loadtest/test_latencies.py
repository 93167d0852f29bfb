"""The histogram: three digits of every latency, from microseconds to an hour, and a file that others read."""

from __future__ import annotations

import re

import numpy as np
import pytest

from catstream.applications.loadtest.latencies import PERCENTILES, Latencies
from catstream.errors import VideoError


def test_percentiles_are_those_of_the_sorted_latencies_to_three_digits(rng):
    seconds = rng.lognormal(-4, 1, 20_001)
    latencies = Latencies(seconds)
    for name, percentile in PERCENTILES.items():
        exact = np.percentile(seconds, percentile, method="inverted_cdf")
        assert latencies[name] == pytest.approx(exact, rel=2e-3), name


def test_the_distribution_rises_from_the_shortest_to_the_longest_latency(rng):
    seconds = rng.lognormal(-4, 1, 2_000)
    shares, values = Latencies(seconds).distribution()
    assert (shares[0], shares[-1]) == (0, 1)
    assert (np.diff(shares) >= 0).all()
    assert (values[0], values[-1]) == pytest.approx((seconds.min(), seconds.max()), rel=2e-3)
    assert values == pytest.approx(np.quantile(seconds, shares, method="inverted_cdf"), rel=5e-3)


def test_a_latency_above_an_hour_is_counted_as_an_hour():
    assert Latencies([0.01, 1e6])["max"] == pytest.approx(3600, rel=1e-2)


def test_percentiles_without_latencies_are_nan():
    assert set(Latencies([]).figures().values()) == {None}


def test_the_file_has_the_format_of_hdr_histogram(tmp_path):
    Latencies([0.001] * 90 + [0.050] * 10).write(tmp_path / "track.hgrm")
    lines = (tmp_path / "track.hgrm").read_text().splitlines()
    assert lines[0].split() == ["Value", "Percentile", "TotalCount", "1/(1-Percentile)"]
    rows = [list(map(float, line.split())) for line in lines if re.match(r" *\d", line)]
    assert rows[0][0] == pytest.approx(1.0, rel=1e-3)
    assert rows[-1][:3] == pytest.approx([50.0, 1.0, 100], rel=1e-3)


def test_an_unwritable_path_is_an_error(tmp_path):
    with pytest.raises(VideoError, match="give another folder"):
        Latencies([0.1]).write(tmp_path / "missing" / "track.hgrm")

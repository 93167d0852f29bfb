"""The times of frames: FFmpeg's best effort, monotonic."""

from __future__ import annotations

from fractions import Fraction

import pytest

from catstream.video.times import FrameClock

#: Time stamps of presentation and of decoding in hundredths of a second, and the times of the frames in the same unit.
STAMPS = {
    "in order": ([50, 54, 62], [50, 54, 62], [0, 4, 12]),
    "only of decoding": ([None, None, None], [8, 12, 16], [0, 4, 8]),
    "in the order of decoding": ([0, 12, 4, 8, 24], [4, 8, 12, 16, 20], [0, 12, 16, 20, 24]),
    "that repeat": ([0, 4, 4, 8], [None] * 4, [0, 4, 8, 12]),
    "that are missing": ([0, None, 8], [None] * 3, [0, 4, 8]),
    "missing at the start": ([None, 4, 8], [None] * 3, [0, 4, 8]),
    "of joined files": ([1000, 1030, 0, 30, 34], [None] * 5, [0, 30, 34, 64, 68]),
}


@pytest.mark.parametrize(("pts", "dts", "times"), STAMPS.values(), ids=STAMPS)
def test_times_increase_from_zero_as_in_ffmpeg(pts, dts, times):
    clock = FrameClock(25, Fraction(1, 100))
    found = [clock.time(number, *stamps) for number, stamps in enumerate(zip(pts, dts, strict=True))]
    assert [100 * time for time in found] == pytest.approx(times)

"""Fixtures of evaluation (a short sequence with truth) and of load tests (tracks as an observer sees them)."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.measure.camera import Schedule
from catstream.measure.datasets import Sequence, find_sequences
from catstream.measure.latency import REST, Measures, Reading
from catstream.measure.load_result import Plan, Result
from catstream.wire.messages import Track

BOX = Box(10.0, 10.0, 20.0, 20.0)


@pytest.fixture
def schedule() -> Schedule:
    """Ten frames a second from moment 100 on."""
    return Schedule(start=100.0, rate=10.0)


@pytest.fixture
def track(schedule) -> Callable[..., tuple[float, Track]]:
    """A track of a frame of the schedule that came some seconds after the frame."""

    def made(number: int, after: float, *, frame: int | None = None) -> tuple[float, Track]:
        due = schedule.due(number)
        frame = number if frame is None else frame
        return due + after, Track(frame, 0.0, "present", BOX, 0.9, 1, due)

    return made


@pytest.fixture
def result() -> Callable[..., Result]:
    """A result of streams with these latencies to the track."""

    def made(*streams: list[float], tracked: float = 1.0, success: float = 0.9, **others) -> Result:
        measures = []
        for seconds in map(np.array, streams):
            frames = np.arange(len(seconds))
            seen = {"due": 100 + frames / 10, "tracked": frames < tracked * len(seconds)}
            measures.append(Measures(**seen, track=seconds, model=seconds, success=success))
        readings = [Reading(105.0, 5.0, {"detector 0": 0.5, REST: 0.1}, {"detector 0": 10**8})]
        facts = {"readings": readings, "subscribers": [], "camera_late": 0.001}
        return Result(Plan(streams=len(streams)), 10.0, measures, **{**facts, **others})

    return made


@pytest.fixture
def sequence(walk: Path) -> Sequence:
    return find_sequences(walk)[0]


@pytest.fixture
def found(sequence: Sequence) -> np.ndarray:
    """Boxes with small errors, float64 (12, 4)."""
    return np.nan_to_num(sequence.boxes, nan=30.0) + np.array([2, 1, 1, -1])

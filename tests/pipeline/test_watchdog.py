"""The watchdog: a process that is slow is given time, one that stands still is noticed."""

from __future__ import annotations

import signal
import time
from contextlib import ExitStack, closing

import numpy as np
import pytest

from catstream.compression.compressor import Compressor
from catstream.messages.heads import APPEARANCE
from catstream.messages.kinds import Features, ObjectFeatures, TrainingRows
from catstream.run.job import Job
from catstream.services.compressor import CompressorLoop
from catstream.services.detector import opening_seconds
from catstream.services.loop import Process
from catstream.services.timing import STUCK_SECONDS
from catstream.services.watchdog import Watchdog
from catstream.settings import Settings


@pytest.fixture
def watchdog():
    watchdog = Watchdog()
    yield watchdog
    watchdog.close()


def test_a_watchdog_counts_each_iteration(watchdog):
    loop = Watchdog(watchdog.handle)
    for turn in range(1, 4):
        loop.beat()
        assert watchdog.turns == turn
    assert watchdog.patience == STUCK_SECONDS


def test_a_starting_process_has_a_longer_time_limit_than_a_running_one(watchdog):
    assert watchdog.patience > 20 * STUCK_SECONDS


def test_only_the_announced_long_step_extends_the_time_limit(watchdog):
    watchdog.beat()
    watchdog.allow(60)
    assert watchdog.patience == 60
    watchdog.beat()
    assert watchdog.patience == STUCK_SECONDS


def test_the_time_limit_follows_the_duration_of_recent_iterations(watchdog, monkeypatch):
    clock = [time.monotonic()]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    for seconds in (0.0, 0.0, 4.0):
        clock[0] += seconds
        watchdog.beat()
    assert watchdog.patience == pytest.approx(20, rel=0.1)
    for _ in range(500):
        watchdog.beat()
    assert watchdog.patience == STUCK_SECONDS


def test_a_longer_time_limit_applies_to_each_iteration(watchdog):
    watchdog.allow_each(6)
    for _ in range(3):
        watchdog.beat()
        assert watchdog.patience == STUCK_SECONDS + 6
    watchdog.allow(60)
    assert watchdog.patience == 60


def test_a_compressor_counts_an_iteration_after_each_object_of_a_message(folder, rng, monkeypatch):
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # those of this process stay
    turns, take = [], Compressor.take

    def counted(*arguments):
        turns.append(process.watchdog.turns)
        return take(*arguments)

    monkeypatch.setattr(Compressor, "take", counted)
    rows = TrainingRows.labelled(rng.normal(size=(16, 5)), np.repeat([0, 1], 8))
    objects = {name: ObjectFeatures(None, {APPEARANCE: rows}) for name in ("anna", "ben", "carla")}
    job = Job("walk.mp4", {}, settings=Settings(coreset={"size": 8}), endpoint=str(folder))
    with closing(Process("compressor", job)) as process, ExitStack() as stack:
        loop = CompressorLoop(process, stack)
        loop.insert(Features(1, 0, 0.0, objects))
        turns.append(process.watchdog.turns)
    assert len(turns) == len(set(turns)) == 4


@pytest.mark.parametrize(
    ("part", "first", "passed_over", "each"),
    [
        (slice(None), 0, 0, 0),
        (slice(900, None), 0, 900, 0),
        (slice(900, None, 60), 0, 900, 59),
        (slice(900, None, 60), 10, 900 + 10 * 60, 59),
    ],
)
def test_a_detector_has_time_for_each_frame_of_the_file_that_it_passes_over(part, first, passed_over, each):
    assert opening_seconds(part, first) == pytest.approx((60 + 0.1 * passed_over, 0.1 * each))

"""The watchdog: a long step has to be announced, and each object of a message is a turn."""

import signal
from contextlib import ExitStack, closing

import numpy as np

from catstream.base.settings import Settings
from catstream.compression.compressor import Compressor
from catstream.jobs.job import Job
from catstream.messages.heads import APPEARANCE
from catstream.messages.kinds import Features, ObjectFeatures, TrainingRows
from catstream.processes.compressor import CompressorLoop
from catstream.processes.process import Process
from catstream.processes.shared import LONG_SECONDS, RUNNING_SECONDS, SharedMemory


def test_watchdog_counts_iterations_and_allows_announced_long_steps():
    with closing(SharedMemory()) as memory:
        watchdog = memory.watchdog
        assert watchdog.patience == LONG_SECONDS, "a start takes long"
        loop = SharedMemory(memory.handle).watchdog
        before = watchdog.turns
        loop.beat()
        assert (watchdog.turns, watchdog.patience) == (before + 1, RUNNING_SECONDS)
        loop.allow(300)
        assert watchdog.patience == 300
        loop.limit += 6  # each turn skips frames of the source
        loop.beat()
        assert watchdog.patience == RUNNING_SECONDS + 6


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
        loop.insert(Features(0, 0.0, objects))
        turns.append(process.watchdog.turns)
    assert len(turns) == len(set(turns)) == 4

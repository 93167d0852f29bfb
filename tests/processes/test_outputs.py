"""Backpressure: a detector waits for its program and for the compressor only."""

from contextlib import closing
from dataclasses import replace

import pytest

from catstream.processes.job import Job
from catstream.processes.outputs import Outputs
from catstream.processes.process import Process
from catstream.wire.messages import Features, Tracks
from catstream.wire.results import ResultsReceiver


@pytest.fixture
def process(folder, monkeypatch):
    monkeypatch.setattr("signal.signal", lambda *_: None)  # the handlers of this process stay
    job = Job("walk.mp4", endpoint=str(folder), run="one").resumed(settings={"run.unstored_frames": 4})
    with closing(Process("detector", job)) as made:
        yield made


def test_detector_waits_for_its_program(process):
    waits = []

    def poll():
        """The program reads one frame."""
        waits.append(process.consumer.read)
        process.consumer.read += 1

    owner = ResultsReceiver(replace(process.endpoint, run=""), 5, 0)
    with owner, Outputs(process, poll, lambda *_: None) as outputs:
        outputs._send_features = lambda _: None  # the compressor has room
        for seq in range(1, 8):
            outputs.send(Tracks(seq - 1, {}), Features(seq - 1, 0.0, {}))
        assert waits == [0, 1, 2], "frames 5, 6 and 7 wait for frames 1, 2 and 3"
        assert [owner.receive(60).seq for _ in range(7)] == list(range(1, 8))


def test_signalled_detector_does_not_wait(process):
    process.ending._handle()
    with Outputs(process, lambda: pytest.fail("it waits"), lambda *_: None) as outputs:
        for seq in range(1, 9):
            outputs.send(Tracks(seq - 1, {}), Features(seq - 1, 0.0, {}))
        assert outputs.features.window.sent == 4, "none is stored"
        outputs.features.window._unacknowledged.clear()
        outputs.send(Tracks(8, {}), Features(8, 0.0, {}))
        assert outputs.features.window.sent == 4

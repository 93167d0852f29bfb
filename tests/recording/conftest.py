"""What the tests of recordings share: what three stages said of a short video."""

from __future__ import annotations

import pytest

from catstream.box import Box
from catstream.compression.compressor import Compressor
from catstream.detection.detector import Detector
from catstream.messages import Run
from catstream.recording.file import RecordingWriter
from catstream.settings import Settings
from catstream.training.trainer import Trainer
from catstream.video.source import open_source
from catstream.wire.endpoint import Endpoint, private_folder

SETTINGS = Settings(coreset={"size": 16})


@pytest.fixture(scope="session")
def said(demo_video):
    """Tracks, features and models of a lockstep run of 50 frames, in the order in which they came."""
    path, boxes = demo_video(50)
    detector, compressor, trainer = Detector(SETTINGS), Compressor(SETTINGS), Trainer(SETTINGS)
    messages = []
    with open_source(str(path)) as frames:
        for frame in frames:
            first = detector.seq == 0
            step = detector.init(frame.image, Box(*map(float, boxes[0]))) if first else detector.step(frame.image)
            messages += step
            if (sample := compressor.take(step[1])) is not None:
                messages.append(trainer.train(sample))
                detector.adopt(messages[-1])
    return messages


@pytest.fixture
def written(tmp_path):
    """Writes messages to a file, and says where that is."""

    def record(messages, settings=SETTINGS, **options):
        with RecordingWriter(tmp_path / "run.rec", Run.from_settings(settings.portable()), **options) as writer:
            for message in messages:
                writer.write(message)
        return tmp_path / "run.rec"

    return record


@pytest.fixture
def endpoint():
    """Where to meet."""
    with private_folder() as folder:
        yield Endpoint.parse(str(folder))

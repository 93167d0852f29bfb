"""What the tests of recordings share: what three stages said of a short video."""

from __future__ import annotations

import pytest

from catstream.box import Box
from catstream.compression.forest import Forest
from catstream.detection.objects import Detectors
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import Run
from catstream.settings import Settings
from catstream.sinks.recording.file import RecordingWriter
from catstream.training.trainer import Trainer
from catstream.video.source import open_source

SETTINGS = Settings(coreset={"size": 16})


@pytest.fixture(scope="session")
def said(demo_video):
    """Tracks, features and models of a lockstep run of 50 frames, in the order in which they came."""
    return lockstep(demo_video, {"": 0})


@pytest.fixture(scope="session")
def said_of_two(demo_video):
    """The same of two objects, the second of which begins in the middle of the video."""
    return lockstep(demo_video, {"anna": 0, "ben": 20})


def lockstep(demo_video, begins):
    """What three stages say of objects that begin in these frames; the second one is beside the first."""
    path, boxes = demo_video(50)
    detectors, forest, trainer = Detectors(SETTINGS), Forest(SETTINGS), Trainer(SETTINGS)
    messages = []
    with open_source(str(path)) as frames:
        for frame in frames:
            pyramid = Pyramid(frame.image)
            given = {}
            for number, (name, first) in enumerate(begins.items()):
                if frame.number == first:
                    x, y, w, h = boxes[first]
                    box = Box(x + w if number and x + 2 * w < 320 else x - w * number, y, w, h)
                    given[name] = detectors.begin(name, pyramid, box, frame.time)
            tracks, features = detectors.step(pyramid, frame.time, given)
            messages += [*tracks.tracks.values(), features]
            for sample in forest.take(features):
                messages.append(trainer.train(sample))
                detectors.adopt(messages[-1])
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

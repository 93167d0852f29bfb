"""Subscribers that wait at a named endpoint before the pipeline begins."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

import catstream
from catstream.pipeline import Pipeline
from catstream.settings import Settings

FRAMES = 20


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
def test_a_subscriber_that_was_there_first_gets_every_message(video, folder, tcp, transport):
    path, boxes = video
    place = folder / "run" if transport == "ipc" else tcp
    with ExitStack() as stack:
        tracks = stack.enter_context(catstream.subscribe(place, "tracks", timeout=60))
        features = stack.enter_context(catstream.subscribe(place, "features", timeout=60))
        settings = Settings(run={"endpoint": str(place), "unstored_frames": 16})
        followed = list(Pipeline(path, boxes[0], settings, part=slice(0, FRAMES)))
        assert list(tracks) == followed
        assert [message.frame for message in features] == list(range(FRAMES))
        assert (tracks.missed, features.missed) == (0, 0)

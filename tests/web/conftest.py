"""What the tests of the page share: messages of a pipeline, and a page that is served."""

from __future__ import annotations

from contextlib import ExitStack

import httpx
import numpy as np
import pytest

from catstream.box import Box
from catstream.messages import Features, Model, Preview, Track, TrainingRows
from catstream.web.server import Server

JPEG = b"\xff\xd8\xff\xe0 a picture"


class Facts:
    """Messages about frame after frame."""

    @staticmethod
    def track(frame, version=1, state="present", score=0.75):
        box = None if state == "absent" else Box(4.0, 3.0, 20.0, 10.0)
        return Track(frame + 1, frame, frame / 10, state, box, score, version)

    @staticmethod
    def model(version, frame):
        return Model(version, frame, np.ones(2, np.float32), 0.0)

    @staticmethod
    def features(frame, wrong):
        """Of one row, about which the model of above is so wrong."""
        rows = np.full((1, 2), 0.5 + wrong / 2, np.float32)
        return Features(frame + 1, frame, frame / 10, None, {"appearance": TrainingRows.labelled(rows, 1)})

    @staticmethod
    def preview(frame):
        return Preview(frame, 64, 48, Box(4.0, 3.0, 20.0, 10.0), JPEG + str(frame).encode())


@pytest.fixture
def facts():
    return Facts


@pytest.fixture
def serve(folder):
    """Starts pages: what asks them, and where they are."""
    with ExitStack() as stack:

        def start(**options):
            server = Server(str(folder), port=0, **options)
            stack.enter_context(server.in_background())
            return stack.enter_context(httpx.Client(base_url=server.url.partition("#")[0], timeout=60, verify=False))

        yield start

"""What the tests of the search share: a model of the demo's dahlia, and one of its pagoda."""

import pytest

from catstream.base.box import Box
from catstream.client.saved_model import SavedModel
from catstream.video.source import open_source
from tests.learning import learned_from


@pytest.fixture(scope="session")
def video(demo_video):
    """A short demo video."""
    return demo_video(60)[0]


@pytest.fixture(scope="session")
def model_files(once, video, demo_video):
    """Files of two models that were learned from the first frames of the video."""

    def learn(folder):
        for name, box in (("dahlia", demo_video(60)[1][0]), ("pagoda", Box(4, 60, 70, 70))):
            learned_from(video, box, slice(16)).save(folder / f"{name}.model")

    folder = once("found-models", learn)
    return [folder / "dahlia.model", folder / "pagoda.model"]


@pytest.fixture(scope="session")
def learned(model_files):
    return [SavedModel.load(file) for file in model_files]


@pytest.fixture(scope="session")
def images(video):
    """The frames of the video."""
    with open_source(video) as frames:
        return [frame.image for frame in frames]

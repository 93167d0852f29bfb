"""The coreset trees as files, for subscribers."""

from unittest.mock import Mock

import pytest

from catstream.base.settings import Settings
from catstream.client.saved_model import SavedModel
from catstream.coreset.compressor import Compressor
from catstream.processes.compressor import SavedModels
from catstream.wire.channels import SAVED_MODELS
from catstream.wire.newest import Subscriber
from tests.learning import features

SETTINGS = Settings(coreset={"size": 4})


def compressor(name, rng, frames=6):
    """The compressor of an object that was found in some frames."""
    found = Compressor(SETTINGS, name)
    for frame in range(frames):
        found.take(frame, features(rng), found.version + 1)
    return found


def received(publisher, compressors, reader, after_each=lambda: None):
    """The first message that a subscriber receives."""
    for _ in range(200):
        publisher.serve(compressors, after_each)
        if (message := reader.receive(0.05)) is not None:
            return message
    raise AssertionError("nothing was received")


def test_subscriber_receives_the_trees_of_found_objects(endpoint, rng):
    compressors, after_each = {"anna": Compressor(SETTINGS, "anna"), "ben": compressor("ben", rng)}, Mock()
    with SavedModels(endpoint, SETTINGS) as publisher, Subscriber(SAVED_MODELS, endpoint) as reader:
        message = received(publisher, compressors, reader, after_each)
        assert reader.receive(0.1) is None, "anna was not found yet"
    assert after_each.called, "the process reports to the watchdog after each file"
    assert (message.object, message.version) == ("ben", compressors["ben"].version)
    assert message.file == SavedModel.of(compressors["ben"], SETTINGS).to_bytes()


def test_no_file_is_made_without_a_subscriber(endpoint, rng, monkeypatch):
    monkeypatch.setattr(SavedModel, "of", lambda *_: pytest.fail("a file was made"))
    with SavedModels(endpoint, SETTINGS) as publisher:
        for _ in range(3):
            publisher.serve({"": compressor("", rng)}, Mock())


def test_later_subscriber_receives_the_newest_trees(endpoint, rng):
    compressors = {"": compressor("", rng)}
    with SavedModels(endpoint, SETTINGS) as publisher:
        with Subscriber(SAVED_MODELS, endpoint) as reader:
            first = received(publisher, compressors, reader)
        while publisher.has_subscribers:
            publisher.serve(compressors, Mock())
        compressors[""] = compressor("", rng, frames=30)
        publisher.serve(compressors, Mock())
        with Subscriber(SAVED_MODELS, endpoint) as reader:
            assert received(publisher, compressors, reader).version == compressors[""].version > first.version

"""Learning once more: the same settings give the same models, others give others, and both can be compared."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.errors import RecordingError
from catstream.messages.kinds import Features, Model, ObjectFeatures, TrainingRows
from catstream.sinks.recording.file import Recording
from catstream.sinks.recording.learning import Prequential, learn, prequential_of_recorded
from catstream.wire.codec import encode


def models_of(said):
    return [message for message in said if isinstance(message, Model)]


def test_two_objects_are_learned_again_bit_for_bit_each_with_its_trees(said_of_two, written):
    recording, again = Recording(written(said_of_two)), []
    result = learn(recording, recording.settings, keep=again.append)
    assert len(again) > 5
    assert list(map(encode, again)) == list(map(encode, models_of(said_of_two)))
    assert result.identical == result.models == recording.counts[Model]
    assert {model.object for model in again} == result.levels.keys() == {"anna", "ben"}
    assert result.prequential == prequential_of_recorded(recording)


def test_versions_that_a_trainer_skipped_are_made_and_the_others_are_the_same(said, written):
    skipped = {model.version for model in models_of(said)[1::2]}
    kept = [message for message in said if not (isinstance(message, Model) and message.version in skipped)]
    recording = Recording(written(kept))
    result = learn(recording, recording.settings)
    assert result.identical == recording.counts[Model] == result.models - len(skipped)


@pytest.mark.parametrize("change", [{"coreset.size": 8}, {"teaching.classifier": "one-class"}], ids=str)
def test_other_settings_give_other_models_of_the_same_rows(said, written, change):
    recording = Recording(written(said))
    then, now = (learn(recording, settings) for settings in (recording.settings, recording.settings.but(change)))
    assert now.models
    assert now.identical == 0
    assert now.counters["rows"] == then.counters["rows"]
    assert now.prequential.error != then.prequential.error


def test_if_features_are_missing_nothing_is_learned_unless_requested(said, written):
    recording = Recording(written([message for message in said if getattr(message, "seq", 0) != 4]))
    with pytest.raises(RecordingError, match="misses the features of 1 frame,"):
        learn(recording, recording.settings)
    result = learn(recording, recording.settings, incomplete=True)
    assert result.models
    assert result.counters["seq"] == sum(isinstance(message, Features) for message in said) - 1


def test_a_recording_of_models_alone_teaches_nothing(said, written):
    recording = Recording(written(models_of(said)))
    with pytest.raises(RecordingError, match="holds no features to learn from"):
        learn(recording, recording.settings, incomplete=True)


def test_prequential_error_is_weighted_and_a_frame_is_separated_if_all_of_the_object_scores_above_the_rest(rng):
    model = Model(1, 0, rng.normal(size=4).astype(np.float32), 0.25)
    labels, weights = np.array([1, 1, 0, 0], np.float32), np.array([4, 1, 1, 1], np.float32)
    prequential, errors = Prequential(), []
    for objects in ([0.9, 0.8], [0.2, 0.9]):
        rows = np.array([*objects, 0.5, 0.1], np.float32)[:, None] * model.weights / (model.weights @ model.weights)
        prequential.add(model, ObjectFeatures(None, {"appearance": TrainingRows(rows, labels, weights)}))
        errors += [(float(row @ model.weights) + 0.25 - label) ** 2 for row, label in zip(rows, labels, strict=True)]
    assert prequential.error == pytest.approx(np.average(errors, weights=[*weights, *weights]), rel=1e-5)
    assert prequential.separated_share == 0.5

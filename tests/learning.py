"""Learned states of an object: synthetic, or from frames of a video."""

import numpy as np

from catstream.base.box import Box, Window
from catstream.features.layout import ROW_LENGTH
from catstream.tracker import Tracker
from catstream.video.source import open_source
from catstream.wire.heads import APPEARANCE, EXTENT
from catstream.wire.messages import DetectorState, ObjectFeatures, TrainingRows

BOX, WINDOW = Box(1.0, 2.0, 30.0, 40.0), Window(0.0, 0.0, 40.0, 50.0)


def features(rng, appearance=1.0):
    """The features of an object in a frame: rows of the object around its appearance, and of a background around -1."""
    labels = np.repeat(np.float32([1, 0]), 4)
    rows = rng.normal(scale=0.2, size=(8, ROW_LENGTH)).astype(np.float32)
    rows += np.where(labels[:, None], np.float32(appearance), np.float32(-1))
    training = {APPEARANCE: TrainingRows.labelled(rows, labels), EXTENT: TrainingRows.labelled(rows[:4], 1)}
    return ObjectFeatures(BOX, training, DetectorState(0, "confident", WINDOW, WINDOW, WINDOW))


def rows_of(tree):
    """The rows of a coreset tree, C in the paper."""
    return np.vstack([*(node.rows for node in tree.nodes), tree.pending])


def learned_from(video, box, part, settings=None):
    """The saved model of a tracker after a part of a video, with the box of the object in its first frame."""
    tracker = Tracker(settings)
    with open_source(video, part=part) as frames:
        for frame in frames:
            if frame.number:
                tracker.update(frame.image)
            else:
                tracker.init(frame.image, box)
    return tracker.saved_model()

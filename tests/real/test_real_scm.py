"""The sparse collaborative model bridges the frames before the first leaf of a real sequence."""

from itertools import islice

import numpy as np

from catstream.box import Box
from catstream.paper.scm import SparseCollaborativeModel


def test_the_first_frames_are_followed(real):
    sequence = real("OTB_Crossing")
    frames, truth = islice(sequence.frames(), 50), [Box(*box) for box in sequence.boxes[:50]]
    model = SparseCollaborativeModel(next(frames), truth[0], np.random.default_rng(0), particles=40)
    overlaps = [model.follow(frame)[1].overlap(box) for frame, box in zip(frames, truth[1:], strict=True)]
    assert np.mean(np.array(overlaps) > 0.5) >= 0.9

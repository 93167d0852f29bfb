"""What stands in before the first model: ridge regression of the first frame's rows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from catstream import ridge
from catstream.errors import BoxError
from catstream.heads import BACKGROUND
from catstream.messages import Model

if TYPE_CHECKING:
    from catstream.detection.lessons import Lesson

__all__ = ["stand_in"]


def stand_in(lesson: Lesson) -> Model:
    """A model of version 0, from the object's copies against the background of one frame.

    Raises
    ------
    BoxError
        Where the two are the same.
    """
    background = lesson.rows[lesson.labels == 0]
    mean, background_mean = lesson.rows[lesson.labels == 1].mean(axis=0), background.mean(axis=0)
    weights = ridge.between(background, mean - background_mean, BACKGROUND.ridge)
    contrast = float(weights @ (mean - background_mean))
    if not contrast > 0:
        raise BoxError("the object in the box looks like all that is around it: give another box, or another frame")
    weights /= np.float32(contrast)
    return Model(0, 0, weights, -float(weights @ background_mean))

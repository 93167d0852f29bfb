"""Accuracy: scenes that are hard on purpose, in which worse detection or training costs more than the bound allows."""

import cv2
import numpy as np
import pytest

from catstream.measure.scores import score
from catstream.tracker import Tracker
from catstream.video.rendered import Demo


def snow(image, rng):
    """Little contrast, no colours, and as much noise."""
    noisy = (0.4 * image + 60 + rng.normal(0, 28, image.shape)).clip(0, 255).astype(np.uint8)
    return cv2.cvtColor(cv2.cvtColor(noisy, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)


def bar(image, _):
    """A bar over the middle, which the object is behind now and then."""
    image[120:168] = 70
    return image


def mist(image, rng):
    """A seventh of the contrast."""
    return (0.15 * image + 150 + rng.normal(0, 5, image.shape)).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("change", "frames", "least"),
    [(snow, range(0, 300, 2), 0.72), (bar, range(0, 400, 3), 0.67), (mist, range(0, 400, 3), 0.77)],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_area_under_curve_stays_above_the_bound_in_a_hard_scene(change, frames, least):
    """With other seeds, it is at least 0.74, 0.69 and 0.79: see `score` for the measure."""
    demo, tracker, found, truth = Demo((320, 240)), Tracker(), [], []
    for number in frames:
        image, box = demo.image(number)
        image = change(image, np.random.default_rng(number))
        if found:
            tracker.update(image)
        else:
            tracker.init(image, box)
        found.append(tracker.track.box or [np.nan] * 4)
        truth.append(box or [np.nan] * 4)
    assert score(np.array(found, float), np.array(truth, float)).auc > least

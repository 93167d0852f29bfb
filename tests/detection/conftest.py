"""What the tests of detection share: things to look at."""

import cv2
import numpy as np
import pytest


@pytest.fixture
def texture():
    """A function that paints coloured blotches: uint8 (height, width, 3), each blotch about `cell` pixels wide."""
    rng = np.random.default_rng(11)

    def paint(height, width, cell):
        coarse = rng.integers(0, 256, (height // cell + 1, width // cell + 1, 3), np.uint8)
        return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)

    return paint

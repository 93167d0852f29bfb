"""Lab: as OpenCV converts colours."""

import cv2
import numpy as np

from catstream.features import lab


def test_every_third_level_of_each_channel_is_converted_as_opencv_does():
    levels = np.arange(0, 256, 3, np.uint8)
    colours = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    np.testing.assert_array_equal(lab.converted(colours), cv2.cvtColor(colours[None], cv2.COLOR_BGR2LAB)[0])

"""Lab: as OpenCV converts colours, and the same on every processor."""

import cv2
import numpy as np

from catstream.features import lab


def test_every_third_level_of_each_channel_is_converted_as_opencv_does_but_for_one_level_in_few_colours():
    levels = np.arange(0, 256, 3, np.uint8)
    colours = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    ours = lab.converted(colours).astype(int)
    off = np.abs(ours - cv2.cvtColor(colours[None], cv2.COLOR_BGR2LAB)[0])
    assert off.max() <= 1
    assert np.mean(off > 0) < 1e-3


def test_no_root_is_so_near_to_a_half_that_a_processor_could_round_it_otherwise():
    light = np.arange(len(lab._ROOTS)) / lab._LINEAR[-1]
    root = np.where(light < 216 / 24389, light * (841 / 108) + 16 / 116, light ** (1 / 3)) * (1 << lab._ROOT_BITS)
    np.testing.assert_array_less(np.abs(root - lab._ROOTS), 0.5 - 1e-6)

"""The pyramid of a frame: windows of a large object are cut from a smaller copy of it, which they share."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["Pyramid"]


class Pyramid:
    """A frame, and the same at a half, a quarter ... of its size, each made when it is first asked for.

    Parameters
    ----------
    image : uint8 (h, w, 3) or (h, w)
    """

    def __init__(self, image: np.ndarray) -> None:
        self.image = image
        self._halves = [image]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frame in pixels."""
        height, width = self.image.shape[:2]
        return width, height

    def near(self, scale: float) -> tuple[np.ndarray, int]:
        """The smallest image whose pixels are at most `scale` pixels of the frame wide, and how wide: 1, 2, 4 ...

        So linear interpolation skips none of the frame's pixels, or few. An odd last row or column is left out.

        >>> image, wide = Pyramid(np.zeros((90, 121, 3), np.uint8)).near(5.9)
        >>> image.shape, wide
        ((22, 30, 3), 4)
        """
        level = 0
        while 2 << level <= scale and min(self._halves[level].shape[:2]) > 1:
            level += 1
            if level == len(self._halves):
                self._halves.append(_half(self._halves[-1]))
        return self._halves[level], 1 << level


def _half(image: np.ndarray) -> np.ndarray:
    """The mean of each 2 x 2 pixels."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)

"""Small JPEG images of frames, for people to look at."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["SIDE", "jpeg"]

#: Maximum length of the longer side in pixels.
SIDE = 640

_QUALITY = 80


def jpeg(image: np.ndarray, side: int = SIDE) -> bytes:
    """Return an image as JPEG, scaled down if its longer side exceeds `side` pixels.

    Parameters
    ----------
    image : uint8 (h, w, 3) BGR, or (h, w) grey

    >>> jpeg(np.zeros((480, 1280, 3), np.uint8))[:3].hex()
    'ffd8ff'
    """
    height, width = image.shape[:2]
    if (scale := side / max(height, width)) < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes()

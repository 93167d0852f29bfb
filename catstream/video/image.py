"""Converts the image arrays of other libraries to the 8-bit BGR arrays that catstream computes with, and to JPEG."""

from __future__ import annotations

import cv2
import numpy as np

from catstream.errors import FrameError
from catstream.numerics.arrays import is_finite

_CHANNELS = (1, 3, 4)
_HALF_STEP = 0.5 / 255  # interpolation may exceed the range from 0 to 1 by this much
_EXPECTED = "a frame is a numpy array (h, w, 3), blue green red, or (h, w) grey, of uint8, uint16 or float from 0 to 1"


def as_bgr(image: object) -> np.ndarray:
    """Return an image as a writable, contiguous uint8 array (h, w, 3), blue green red; no copy is made if it is one.

    Parameters
    ----------
    image : array of shape (h, w, 3) BGR, (h, w, 4) BGRA, (h, w) or (h, w, 1) grey. uint8 stays as it is; uint16 is
        reduced to its upper 8 bits; floats from 0 to 1 are scaled to 255 and rounded. An alpha channel is dropped. The
        array may be read-only and not contiguous

    Raises
    ------
    FrameError
        For any other array.

    >>> as_bgr(np.full((2, 2, 1), 0.5))[0, 0]
    array([128, 128, 128], dtype=uint8)
    """
    pixels = _eight_bit(_validated(image))
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        pixels = np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2)
    elif pixels.shape[2] == 4:
        pixels = pixels[:, :, :3]
    return np.require(pixels, requirements=["C", "W"])


def _validated(image: object) -> np.ndarray:
    if image is None:
        raise FrameError(
            f"{_EXPECTED}, got None: a read has failed, as at the end of a video; check what it returns first"
        )
    if not isinstance(image, np.ndarray):
        raise FrameError(
            f"{_EXPECTED}, got {type(image).__name__}: turn it into such an array first, as np.asarray does"
        )
    shape = image.shape
    if not (image.ndim == 2 or (image.ndim == 3 and shape[2] in _CHANNELS)):
        hint = "give one of this shape"
        if image.ndim == 3 and shape[0] in _CHANNELS:
            hint = "the channels come last, np.moveaxis(frame, 0, -1) puts them there"
        elif image.ndim == 4:
            hint = "give one image of a batch at a time"
        raise FrameError(f"{_EXPECTED}, got the shape {shape}: {hint}")
    if not image.size:
        raise FrameError(f"{_EXPECTED}, got the shape {shape}, which has no pixels: check how it was cropped")
    return np.asarray(image)


def _eight_bit(image: np.ndarray) -> np.ndarray:
    if image.dtype == np.uint8:
        return image
    if image.dtype.kind == "u" and image.itemsize == 2:
        return (image >> 8).astype(np.uint8)
    if image.dtype == bool:
        raise FrameError(f"{_EXPECTED}, got bool: a mask is not a picture, 255 * frame.astype(np.uint8) is one")
    if image.dtype.kind not in "fui":
        raise FrameError(f"{_EXPECTED}, got {image.dtype}: check where the frame comes from")
    if image.dtype.kind != "f":
        raise FrameError(
            f"{_EXPECTED}, got {image.dtype}: frame.astype(np.uint8) if its values are brightness from 0 to 255"
        )
    if not is_finite(image):
        raise FrameError(f"{_EXPECTED}, got {image.dtype} with NaN or infinity: check how the frame was computed")
    low, high = float(image.min()), float(image.max())
    if not (low >= -_HALF_STEP and high <= 1 + _HALF_STEP):
        raise FrameError(
            f"{_EXPECTED}, got {image.dtype} from {low:g} to {high:g}: "
            "frame.astype(np.uint8) if its values are brightness from 0 to 255"
        )
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


def jpeg(image: np.ndarray, side: int | None = None, quality: int = 80) -> bytes:
    """Return an image as JPEG, scaled down if its longer side exceeds `side` pixels.

    Parameters
    ----------
    image : uint8 (h, w, 3) BGR, or (h, w) grey

    >>> jpeg(np.zeros((480, 1280, 3), np.uint8), side=640)[:3].hex()
    'ffd8ff'
    """
    height, width = image.shape[:2]
    if side is not None and (scale := side / max(height, width)) < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()

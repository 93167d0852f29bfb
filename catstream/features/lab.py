"""Lab: colours as lightness, a and b, each from 0 to 255, as OpenCV's `COLOR_BGR2LAB` converts them.

OpenCV's own conversion makes tables first, for 90 ms in each process, and costs a call for each patch. Its tables
differ in a few entries between processors, those here do not: a few colours in ten thousand differ by one level.
"""

from __future__ import annotations

import numpy as np

from catstream.features.compiled import kernel
from catstream.numerics.arrays import UInt8

_LINEAR_BITS, _ROOT_BITS, _SHARE_BITS = 3, 15, 12  # of the fractions of whole numbers


def _linear() -> np.ndarray:
    """Linear light of each of the 256 levels of sRGB."""
    level = np.arange(256) / 255
    light = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    levels: np.ndarray = np.rint((255 << _LINEAR_BITS) * light).astype(np.int32)
    return levels


def _roots() -> np.ndarray:
    """The root of CIE Lab of each linear light, to 1.5 times white."""
    light = np.arange(256 * 3 // 2 << _LINEAR_BITS) / (255 << _LINEAR_BITS)
    root = np.where(light < 216 / 24389, light * (841 / 108) + 16 / 116, np.cbrt(light))
    roots: np.ndarray = np.rint(root * (1 << _ROOT_BITS)).astype(np.int32)
    return roots


_LINEAR, _ROOTS = _linear(), _roots()
#: Shares of red, green and blue in X, Y and Z, which are 1 for the white of D65.
_XYZ = [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
_SHARES = np.rint(np.divide(_XYZ, [[0.950456], [1.0], [1.088754]]) * (1 << _SHARE_BITS)).astype(np.int32)
_ZERO_LIGHT = (16 * 255 * (1 << _ROOT_BITS) + 50) // 100  # what 116 roots are above the lightness


def of_colour(blue: int, green: int, red: int) -> tuple[int, int, int]:
    """Lab of a colour: part of a kernel."""
    r, g, b = _LINEAR[red], _LINEAR[green], _LINEAR[blue]
    half = 1 << (_SHARE_BITS - 1)
    x = _ROOTS[(r * _SHARES[0, 0] + g * _SHARES[0, 1] + b * _SHARES[0, 2] + half) >> _SHARE_BITS]
    y = _ROOTS[(r * _SHARES[1, 0] + g * _SHARES[1, 1] + b * _SHARES[1, 2] + half) >> _SHARE_BITS]
    z = _ROOTS[(r * _SHARES[2, 0] + g * _SHARES[2, 1] + b * _SHARES[2, 2] + half) >> _SHARE_BITS]
    half = 1 << (_ROOT_BITS - 1)
    light = (296 * y - _ZERO_LIGHT + half) >> _ROOT_BITS
    return light, ((500 * (x - y) + half) >> _ROOT_BITS) + 128, ((200 * (y - z) + half) >> _ROOT_BITS) + 128


def converted(colours: np.ndarray) -> np.ndarray:
    """Lab of colours, uint8 (k, 3): blue, green, red to lightness, a, b.

    >>> converted(np.array([[0, 0, 0], [255, 255, 255], [0, 0, 255]], np.uint8))
    array([[  0, 128, 128],
           [255, 128, 128],
           [136, 208, 195]], dtype=uint8)
    """
    lab = np.empty_like(colours)
    _convert(colours, lab)
    return lab


@kernel("void(uint8[:,::1], uint8[:,::1])")
def _convert(colours: UInt8, lab: UInt8) -> None:
    for k in range(len(colours)):
        lab[k, 0], lab[k, 1], lab[k, 2] = of_colour(colours[k, 0], colours[k, 1], colours[k, 2])

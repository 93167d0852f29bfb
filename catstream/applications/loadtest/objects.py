"""Boxes of several objects in one frame, for load tests: an object and patches of the picture beside it."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from catstream.box import Box
from catstream.errors import BoxError, SettingsError
from catstream.tracker import Tracker

__all__ = ["several"]

_SIDE = 40  # width and height of a patch, pixels
_MARGIN = 8  # from the edge of the frame, pixels


def several(image: np.ndarray, box: Box, count: int, name: str = "") -> dict[str, Box]:
    """Return the boxes of `count` objects in an image, by name.

    Parameters
    ----------
    box, name : the first object; the others are patches of the image that do not overlap it, `patch-1`, `patch-2` ...

    Raises
    ------
    SettingsError
        If there are not enough patches that can be tracked.
    """
    height, width = image.shape[:2]
    found = {name: box}
    for y in range(_MARGIN, height - _SIDE, _SIDE):
        for x in range(_MARGIN, width - _SIDE, _SIDE):
            patch = Box(float(x), float(y), float(_SIDE), float(_SIDE))
            if len(found) < count and not patch.overlap(box):
                with suppress(BoxError):  # it looks like its surroundings
                    Tracker().init(image, patch)
                    found[f"patch-{len(found)}"] = patch
    if len(found) < count:
        raise SettingsError(
            f"the first image of {width}x{height} pixels has room for {len(found)} objects, not {count}: "
            "give fewer objects, or larger images"
        )
    return found

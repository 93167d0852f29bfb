"""`Box`: an axis-aligned rectangle in pixels, `x, y, w, h`, the format of the public benchmarks."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable
from typing import NamedTuple

from catstream.errors import BoxError

__all__ = ["Box"]


class Box(NamedTuple):
    """A rectangle in pixels: top left corner, width and height.

    Examples
    --------
    >>> Box(10, 20, 30, 40).centre
    (25.0, 40.0)
    >>> Box(0, 0, 10, 10).overlap(Box(5, 0, 10, 10))
    0.3333333333333333
    """

    x: float
    y: float
    w: float
    h: float

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the box, (x, y)."""
        return self.x + self.w / 2, self.y + self.h / 2

    @property
    def area(self) -> float:
        """Area in square pixels."""
        return self.w * self.h

    def scaled(self, across: float, down: float | None = None) -> Box:
        """Return the box with the same centre, `across` times the width and `down` times the height.

        If `down` is None, the height is scaled by `across` too.
        """
        w, h = self.w * across, self.h * (across if down is None else down)
        return Box(self.x + (self.w - w) / 2, self.y + (self.h - h) / 2, w, h)

    def centred(self, x: float, y: float) -> Box:
        """Return a box of the same size with another centre."""
        return Box(x - self.w / 2, y - self.h / 2, self.w, self.h)

    def with_centre_in(self, width: int, height: int) -> Box:
        """Return the box, moved if necessary so that its centre is inside a frame of this size.

        Examples
        --------
        >>> Box(90, 10, 20, 20).with_centre_in(80, 60)
        Box(x=69.0, y=10.0, w=20, h=20)
        """
        x, y = self.centre
        return self.centred(min(max(x, 0), width - 1), min(max(y, 0), height - 1))

    def overlap(self, other: Box) -> float:
        """Return the intersection over union with another box, from 0 to 1."""
        w = min(self.x + self.w, other.x + other.w) - max(self.x, other.x)
        h = min(self.y + self.h, other.y + other.h) - max(self.y, other.y)
        if w <= 0 or h <= 0:
            return 0.0
        shared = w * h
        return shared / (self.area + other.area - shared)

    @classmethod
    def parse(cls, value: str | Iterable[float]) -> Box:
        """Make a box from four numbers or from a text `x,y,w,h`, separated by commas, blanks or tabs.

        Raises
        ------
        BoxError
            If the value is not four numbers.

        Examples
        --------
        >>> Box.parse("10,20,30,40")
        Box(x=10.0, y=20.0, w=30.0, h=40.0)
        >>> import numpy as np
        >>> Box.parse(np.array([10, 20, 30, 40])) == Box.parse([10, 20, 30, 40])
        True
        """
        try:
            fields = value.replace(",", " ").split() if isinstance(value, str) else list(value)
            x, y, w, h = map(float, fields)
        except (TypeError, ValueError):
            raise BoxError(
                f"a box is four numbers x,y,w,h in pixels, got {reprlib.repr(value)}: for example 120,80,64,48"
            ) from None
        return cls(x, y, w, h)

    def validated(self, width: int, height: int) -> Box:
        """Return the box unchanged if tracking can start with it in a frame of this size.

        Raises
        ------
        BoxError
            If a number is not finite, the width or height is less than 2 pixels or more than twice that of the frame,
            or the centre is outside the frame.
        """
        if not all(math.isfinite(value) for value in self):
            raise BoxError(f"a box needs four finite numbers, got {self}: give x,y,w,h in pixels")
        if self.w < 2 or self.h < 2:
            raise BoxError(f"a box needs a width and a height of at least 2 pixels, got {self.w:g} x {self.h:g}")
        # With its centre inside the frame, such a box covers the whole frame: it does not select an object.
        if self.w > 2 * width or self.h > 2 * height:
            raise BoxError(
                f"a box may be at most twice as wide and high as the frame of {width} x {height} pixels, got "
                f"{self.w:g} x {self.h:g}: draw it tight around the object"
            )
        x, y = self.centre
        if not (0 <= x < width and 0 <= y < height):
            raise BoxError(
                f"the box {self} has its centre at ({x:g}, {y:g}), outside the frame of "
                f"{width} x {height} pixels: give x,y,w,h with x from the left and y from the top"
            )
        return self

    def __str__(self) -> str:
        return ",".join(f"{value:g}" for value in self)

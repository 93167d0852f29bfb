"""Boxes and windows: axis-aligned rectangles in pixels, `x, y, w, h`.

A `Box` is the reported result: tight around the object, as in the benchmarks. A `Window` is the region that features
are computed from: the box with some of its surroundings, 1.25 times as wide and high. With two types, mypy detects a
confusion. `Window.around` and `Window.box` convert.
"""

from __future__ import annotations

import math
import reprlib
import sys
from collections.abc import Iterable
from typing import Annotated, NamedTuple, Self

from msgspec import Meta

from catstream.errors import BoxError

#: Bounds that are checked when a message is decoded; the constructor checks nothing.
_Coordinate = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
_Side = Annotated[float, Meta(gt=0, le=sys.float_info.max)]

_CONTEXT = 1.25  # window to box: an object is located better with its outline than with a factor of 1


class _Rectangle(NamedTuple):
    """A rectangle in pixels: top left corner, width and height."""

    x: _Coordinate
    y: _Coordinate
    w: _Side
    h: _Side

    @property
    def centre(self) -> tuple[float, float]:
        """Centre, (x, y)."""
        return self.x + self.w / 2, self.y + self.h / 2

    @property
    def area(self) -> float:
        """Area in square pixels."""
        return self.w * self.h

    def scaled(self, across: float, down: float | None = None) -> Self:
        """Return the rectangle with the same centre; `across` scales the width, `down` the height (None: `across`)."""
        w, h = self.w * across, self.h * (across if down is None else down)
        return type(self)(self.x + (self.w - w) / 2, self.y + (self.h - h) / 2, w, h)

    def centred(self, x: float, y: float) -> Self:
        """Return the rectangle of the same size with another centre."""
        return type(self)(x - self.w / 2, y - self.h / 2, self.w, self.h)

    def with_centre_in(self, width: int, height: int) -> Self:
        """Return the rectangle, moved if necessary so that its centre is inside a frame of this size.

        Examples
        --------
        >>> Box(90, 10, 20, 20).with_centre_in(80, 60)
        Box(x=69.0, y=10.0, w=20, h=20)
        """
        x, y = self.centre
        return self.centred(min(max(x, 0), width - 1), min(max(y, 0), height - 1))

    def overlap(self, other: Self) -> float:
        """Return the intersection over union with another rectangle, from 0 to 1."""
        shared = self._intersection(other)
        return shared / (self.area + other.area - shared)

    def share_in(self, other: Self) -> float:
        """Return the share of the area that is inside another rectangle, from 0 to 1."""
        return self._intersection(other) / self.area

    def _intersection(self, other: Self) -> float:
        w = min(self.x + self.w, other.x + other.w) - max(self.x, other.x)
        h = min(self.y + self.h, other.y + other.h) - max(self.y, other.y)
        return w * h if w > 0 and h > 0 else 0.0


class Box(_Rectangle):
    """The bounding box of an object in pixels of the frame: top left corner, width and height.

    Examples
    --------
    >>> Box(10, 20, 30, 40).centre
    (25.0, 40.0)
    >>> Box(0, 0, 10, 10).overlap(Box(5, 0, 10, 10))
    0.3333333333333333
    """

    __slots__ = ()

    @classmethod
    def parse(cls, value: str | Iterable[float]) -> Box:
        """Make a box from four numbers, or a text `x,y,w,h` with commas, blanks or tabs; BoxError otherwise.

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

    def rounded(self) -> tuple[int, int, int, int]:
        """Return x, y, w, h in whole pixels, at least one wide and high, for `cv2.rectangle`.

        Examples
        --------
        >>> Box(10.6, 20.4, 30.2, 0.3).rounded()
        (11, 20, 30, 1)
        """
        left, top, right, bottom = (round(value) for value in (self.x, self.y, self.x + self.w, self.y + self.h))
        return left, top, max(right - left, 1), max(bottom - top, 1)

    def checked(self) -> Box:
        """Return the box unchanged; BoxError if a number is not finite, or a side is shorter than 2 pixels."""
        if not all(math.isfinite(value) for value in self):
            raise BoxError(f"a box needs four finite numbers, got {self}: pass x,y,w,h in pixels")
        if self.w < 2 or self.h < 2:
            raise BoxError(f"a box needs a width and a height of at least 2 pixels, got {self.w:g} x {self.h:g}")
        return self

    def validated(self, width: int, height: int) -> Box:
        """Return the box unchanged if tracking can start with it in a frame of this size.

        BoxError if `checked` fails, the box is more than twice as wide or high as the frame, or its centre is outside.
        """
        self.checked()
        # With its centre inside the frame, such a box covers the whole frame: it does not select an object.
        if self.w > 2 * width or self.h > 2 * height:
            raise BoxError(
                f"the box of {self.w:g} x {self.h:g} pixels is over twice as large as the frame of {width} x {height}: "
                "draw it tightly around the object"
            )
        x, y = self.centre
        if not (0 <= x < width and 0 <= y < height):
            raise BoxError(
                f"the box {self} is centred outside the frame of {width} x {height} pixels: pass x,y,w,h with x from "
                "the left and y from the top"
            )
        return self

    def __str__(self) -> str:
        return ",".join(f"{value:g}" for value in self)


class Window(_Rectangle):
    """The part of a frame that features are computed from: the box of an object and some of its surroundings.

    Examples
    --------
    >>> window = Window.around(Box(10, 20, 40, 80))
    >>> window
    Window(x=5.0, y=10.0, w=50.0, h=100.0)
    >>> window.box()
    Box(x=10.0, y=20.0, w=40.0, h=80.0)
    """

    __slots__ = ()

    @classmethod
    def around(cls, box: Box) -> Self:
        """The window of a box, 1.25 times as wide and high, with the same centre."""
        return cls(*box).scaled(_CONTEXT)

    def box(self) -> Box:
        """The box of a window: the inverse of `around`."""
        return Box(*self.scaled(1 / _CONTEXT))

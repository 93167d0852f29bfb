"""The layout of a window and of its feature row: sizes alone, so that what needs no features imports no kernels."""

from __future__ import annotations

CELL = 8  #: pixels a cell is wide and high
WINDOW = 8  #: cells a window is wide and high
CHANNELS = 34  #: numbers a cell: 31 HOG, 3 colour
MARGIN = 2  #: cells around a crop beyond which no pixel changes a feature
SIDE = CELL // 2  #: shades a cell is wide and high
LIGHT = 8  #: levels of lightness that are distinguished
CHROMA = 6  #: levels of a and of b that are distinguished
SHADES = LIGHT * CHROMA * CHROMA  #: shades that are distinguished

_PLACES = WINDOW * WINDOW * CHANNELS
#: The columns of a row that hold the histogram of colours.
COLOURS = slice(_PLACES, _PLACES + SHADES)


def row_length() -> int:
    """Length d of a feature row.

    >>> row_length()
    2464
    """
    return COLOURS.stop

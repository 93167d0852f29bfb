"""The layout of a window and of its feature row: sizes alone, so that what needs no features imports no kernels."""

from __future__ import annotations

CELL = 8  #: pixels a cell is wide and high
WINDOW = 8  #: cells a window is wide and high
CHANNELS = 34  #: numbers a cell: 31 HOG, 3 colour
MARGIN = 2  #: cells around a crop beyond which no pixel changes a feature
STRIDE = 2 * CELL  #: pixels from one vector of a descriptor to the next
EDGE = 4  #: cells around a crop beyond which pixels hardly change a vector of a descriptor
PLACES = WINDOW * CELL // STRIDE  #: vectors of a descriptor that a window is wide and high
SIDE = CELL // 2  #: shades a cell is wide and high
LIGHT = 8  #: levels of lightness that are distinguished
CHROMA = 6  #: levels of a and of b that are distinguished
SHADES = LIGHT * CHROMA * CHROMA  #: shades that are distinguished

_CELLS = WINDOW * WINDOW * CHANNELS
#: The columns of a row that hold the histogram of colours.
COLOURS = slice(_CELLS, _CELLS + SHADES)


def row_length(channels: int = 0) -> int:
    """Length d of a feature row, with a descriptor whose vectors have so many channels.

    >>> row_length(), row_length(32)
    (2464, 2976)
    """
    return COLOURS.stop + PLACES**2 * channels

"""The layout of a window and of its feature row: constants only, so that importing them compiles no kernels."""

from __future__ import annotations

CELL = 8  #: pixels along a side of a cell
WINDOW = 8  #: cells along a side of a window
CHANNELS = 34  #: features of a cell: 31 HOG, 3 colour
MARGIN = 2  #: cells around a crop that its features depend on
STRIDE = 2 * CELL  #: pixels from one vector of a descriptor to the next
EDGE = 4  #: cells around a crop that vectors of a descriptor depend on, almost
PLACES = WINDOW * CELL // STRIDE  #: vectors of a descriptor along a side of a window
SIDE = CELL // 2  #: shades along a side of a cell
LIGHT = 8  #: levels of lightness
CHROMA = 6  #: levels of a and of b
SHADES = LIGHT * CHROMA * CHROMA  #: number of shades

_CELLS = WINDOW * WINDOW * CHANNELS
#: The columns of the histogram of colours in a row.
COLOURS = slice(_CELLS, _CELLS + SHADES)


def row_length(channels: int = 0) -> int:
    """Length d of a feature row, with a descriptor whose vectors have this number of channels.

    >>> row_length(), row_length(32)
    (2464, 2976)
    """
    return COLOURS.stop + PLACES**2 * channels

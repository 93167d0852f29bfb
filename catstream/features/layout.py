"""The layout of a window and of its feature row: constants only, so that importing them compiles no kernels."""

from __future__ import annotations

CELL = 8  #: pixels along a side of a cell
WINDOW = 8  #: cells along a side of a window
CHANNELS = 34  #: features of a cell: 31 HOG, 3 colour
MARGIN = 2  #: cells around a crop on which its features depend
SIDE = CELL // 2  #: shades along a side of a cell
LIGHT = 8  #: levels of lightness
CHROMA = 6  #: levels of a and of b
SHADES = LIGHT * CHROMA * CHROMA  #: number of shades

_CELLS = WINDOW * WINDOW * CHANNELS
#: The columns of the histogram of colours in a row.
COLOURS = slice(_CELLS, _CELLS + SHADES)
ROW_LENGTH = COLOURS.stop  #: length d of a feature row, 2464

"""The features of an image in a grid of cells, and the score of every window in it.

Each cell of 8 x 8 pixels has 31 HOG channels (18 signed and 9 unsigned orientations, 4 texture energies; Felzenszwalb
et al. 2010), of the colour channel with the strongest gradient, then its mean colour in Lab. A window is 8 x 8 cells.

HOG and mean colours depend on the position in the window. An object that deforms or rotates changes both, but not its
colours: 288 shades of Lab, 8 of lightness by 6 x 6 of a and b. So a window's row also contains a histogram of the
shades in its middle 6 x 6 cells, which are mostly object, with 4 x 4 shades per cell. The features are the square roots
of the shares, so that Euclidean distances are Hellinger distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from catstream.features import kernels
from catstream.features.layout import CELL, CHANNELS, CHROMA, COLOURS, LIGHT, MARGIN, ROW_LENGTH, WINDOW
from catstream.features.pyramid import planes_of

_CHROMA_STEP = 10  # Lab units from one level of a or b to the next
_MEAN_COLOUR = slice(CHANNELS - 3, CHANNELS)
#: Limits of a change by the noise of a camera: of a mean colour (9 levels of lightness, 3 of a and b) in all cells but
#: one in a hundred, and of the squares of all features. Noise of 2 levels in the pixels changes 6 levels and 0.08.
_NOISE_OF_COLOUR, _CHANGED, _NOISE = 9 * 1.5 / 255, 0.01, 0.1
_FAR = (np.arange(CELL) + 0.5) / CELL
_WEIGHTS = [np.outer(down, across) for down in (1 - _FAR, _FAR) for across in (1 - _FAR, _FAR)]
#: Weights of the bilinear interpolation of a pixel between four cell centres, float32 (8, 8, 4).
_SHARES = np.stack(_WEIGHTS, axis=-1).astype(np.float32)
_LOWEST = float(np.finfo(np.float32).min)  # the fast arithmetic of the kernels excludes infinity


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Features of a part of an image, cell by cell.

    grid    float32 (rows, columns, 34), HOG and mean colour
    shades  uint16 (4 * rows, 4 * columns), 4 x 4 of each cell
    """

    grid: np.ndarray
    shades: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray) -> Cells:
        """Cells of an image, uint8 (h, w, 3) BGR, whose sides are whole cells."""
        planes = planes_of(image)
        return cls(grid(planes), shades(planes))

    @classmethod
    def within(cls, planes: np.ndarray) -> Cells:
        """Cells of a patch, uint8 (3, h, w), without its margin, where features depend on pixels beyond the patch."""
        edge = MARGIN * CELL
        return cls(grid(planes, MARGIN), shades(planes[:, edge:-edge, edge:-edge]))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.grid.shape[:2]
        return rows, columns

    def differs_by_noise(self, other: Cells) -> bool:
        """Return True if this differs from another image of the same size only by the noise of a camera.

        Noise changes the gradients everywhere, but hardly the mean colour of a cell; motion changes the colours.
        """
        if self.shape != other.shape:
            return False
        change = (self.grid - other.grid).reshape(-1, CHANNELS)
        is_changed = np.abs(change[:, _MEAN_COLOUR]).max(axis=1) > _NOISE_OF_COLOUR
        difference, reference = change.ravel(), other.grid.ravel()
        return bool(is_changed.mean() <= _CHANGED and difference @ difference < _NOISE * (reference @ reference))

    def row(self, row: int, column: int) -> np.ndarray:
        """Feature row of the window whose first cell is (row, column), float32 (d,)."""
        features: np.ndarray = self.rows([(row, column)])[0]
        return features

    def rows(self, corners: Sequence[tuple[int, int]]) -> np.ndarray:
        """Feature rows of the windows whose first cells are at (row, column), float32 (k, d)."""
        features = np.empty((len(corners), ROW_LENGTH), np.float32)
        lines = self.grid.reshape(len(self.grid), -1)
        kernels.cut_rows(lines, self.shades, np.array(corners, np.int64).reshape(-1, 2), features)
        return features

    def respond(self, weights: np.ndarray, bias: float) -> np.ndarray:
        """Score of every window by weights float32 (d,), float32 (rows - 7, columns - 7)."""
        scores = self._cell_scores(weights, bias)
        kernels.add_colour_scores(self.shades, _writable(weights[COLOURS]), _LOWEST, scores)
        return scores

    def respond_above(self, weights: np.ndarray, bias: float, threshold: float) -> np.ndarray:
        """The scores of `respond`, with -inf for every window whose score is below a threshold.

        The colours of a window are only counted if some histogram could raise its score to the threshold: this takes
        three quarters of the time of `respond` if few windows score that high.
        """
        colour_threshold = threshold - highest_colour_score(weights[COLOURS])
        scores = self._cell_scores(weights, bias)
        is_low = scores < colour_threshold
        kernels.add_colour_scores(self.shades, _writable(weights[COLOURS]), colour_threshold, scores)
        scores[is_low | (scores < threshold)] = -np.inf
        return scores

    def _cell_scores(self, weights: np.ndarray, bias: float) -> np.ndarray:
        """Score of every window without its histogram of colours."""
        rows, columns = self.shape
        scores = np.empty((rows - WINDOW + 1, columns - WINDOW + 1), np.float32)
        scores.fill(bias)
        of_cells = _writable(weights[: COLOURS.start]).reshape(WINDOW, -1)
        kernels.add_cell_scores(self.grid.reshape(rows, -1), of_cells, scores)
        return scores


def window_rows(patches: Sequence[np.ndarray]) -> np.ndarray:
    """Feature rows, float32 (k, d), of the windows in the middle of patches, uint8 (3, 96, 96)."""
    features = np.empty((len(patches), ROW_LENGTH), np.float32)
    if len(patches):
        kernels.describe_windows(np.stack(patches), MARGIN, _SHARES, _SHADES_OF, features)
    return features


def grid(planes: np.ndarray, margin: int = 0) -> np.ndarray:
    """HOG and mean colour of every whole cell of an image.

    A cell's features depend on pixels up to `MARGIN` cells away: without that margin, the grid of a crop equals the
    slice of the frame's grid.

    Parameters
    ----------
    planes : uint8 (3, h, w), blue, green and red of the image
    margin : number of cells along each edge to omit

    Returns
    -------
    float32 (h // 8 - 2 margin, w // 8 - 2 margin, 34)

    >>> grid(np.zeros((3, 64, 96), np.uint8)).shape
    (8, 12, 34)
    """
    rows, columns = planes.shape[1] // CELL, planes.shape[2] // CELL
    cells = np.empty((max(rows - 2 * margin, 0), max(columns - 2 * margin, 0), CHANNELS), np.float32)
    if cells.size:
        kernels.describe_cells(planes, margin, _SHARES, cells)
    return cells


def shades(planes: np.ndarray) -> np.ndarray:
    """The shade, uint16 below `SHADES`, of the mean of every 2 x 2 pixels of planes of even size.

    >>> len(set(shades(np.array([[0, 0, 90, 90], [0, 0, 90, 90]], np.uint8)[None].repeat(3, axis=0)).ravel()))
    2
    """
    table = np.empty((planes.shape[1] // 2, planes.shape[2] // 2), np.uint16)
    kernels.look_up_shades(planes, _SHADES_OF, table)
    return table


def highest_colour_score(weights: np.ndarray) -> float:
    """Upper bound of the score of a histogram.

    The features of a histogram are not negative, and its norm is constant. So the bound is its norm times the norm of
    the positive weights (Cauchy-Schwarz).
    """
    return kernels.COLOUR_LENGTH * float(np.linalg.norm(np.maximum(weights, 0)))


def lab(colours: np.ndarray) -> np.ndarray:
    """Lab of colours, uint8 (k, 3): blue, green, red to lightness, a, b.

    >>> lab(np.array([[0, 0, 0], [255, 255, 255], [0, 0, 255]], np.uint8))
    array([[  0, 128, 128],
           [255, 128, 128],
           [136, 208, 195]], dtype=uint8)
    """
    converted = np.empty_like(colours)
    kernels.convert_to_lab(colours, converted)
    return converted


def _shade_table() -> np.ndarray:
    """Shade of every BGR colour with 5 bits per channel, blue first."""
    levels = np.arange(4, 256, 8, dtype=np.uint8)
    colours = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1)
    values = lab(colours.reshape(-1, 3)).astype(int)
    light = values[:, 0] * LIGHT // 256
    chroma = ((values[:, 1:] - 128) // _CHROMA_STEP + CHROMA // 2).clip(0, CHROMA - 1)
    bins: np.ndarray = ((light * CHROMA + chroma[:, 0]) * CHROMA + chroma[:, 1]).astype(np.uint16)
    return bins


_SHADES_OF = _shade_table()


def _writable(array: np.ndarray) -> np.ndarray:
    """The array, or a copy if it is read-only, as arrays of messages are: kernels reject read-only arrays."""
    return array if array.flags.writeable else array.copy()

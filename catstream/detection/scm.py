"""The sparse collaborative model: the tracker that the paper starts with (paper, "System Implementation").

W. Zhong, H. Lu, M.-H. Yang: Robust Object Tracking via Sparsity-based Collaborative Model, CVPR 2012. A particle
filter scores the particles by a product ("Collaborative Model"):

- H, of an adaptive classifier of the whole template against the background: `_Discriminative`;
- L, of a histogram of the object's patches, which detects occlusion: `_Generative`.

Parameters and notation are the authors', with three differences: the particles are spread in proportion to the size of
the object, not in pixels; there is no shear, which a box cannot represent; and L is not computed for particles whose H
excludes the highest product.
"""

from __future__ import annotations

import math
import warnings

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import Lasso

from catstream.base.box import Box
from catstream.base.threads import FILTERS
from catstream.detection.sparse_coding import sparse_codes
from catstream.features.pyramid import Pyramid

_SIDE = 32  # of a template, in pixels
_PENALTY = 0.01  # lambda of all sparse codes
_SPREAD = np.array([0.2, 0.2, 0.015, 0.005, 0.01])  # of particles: shares of the size, logarithms, radians
_POSITIVES, _NEGATIVES = 50, 200
_EVERY = 5  # frames from one update to the next


class SparseCollaborativeModel:
    """Tracks one object from a box in the first frame, without a trainer.

    The same images, box and generator give the same boxes. The cost of a frame is at most proportional to the number of
    particles. The object is never absent.

    Parameters
    ----------
    image : uint8 (h, w, 3) BGR, the first frame
    box : the object in it, in pixels
    rng : generator of templates and particles
    particles : number of boxes that are scored in a frame
    """

    def __init__(self, image: np.ndarray, box: Box, rng: np.random.Generator, particles: int = 300) -> None:
        self._first, self._rng, self._particles = box, rng, particles
        self._state = np.array([*box.centre, 0.0, 0.0, 0.0])
        self._frames = 1
        grey = _grey(image)
        template = self._cuts(grey, self._state[None])
        positives = self._cuts(grey, self._shifted(_POSITIVES, 0.0, 0.02))
        self._discriminative = _Discriminative.trained(positives, self._background(grey))
        self._generative = _Generative.from_template(template[0], int(rng.integers(2**31)))

    def track(self, image: np.ndarray) -> tuple[float, Box]:
        """Track the object in the next frame, of the size of the first one.

        Returns
        -------
        score, 0 to 1, above 0.5 if templates of the object reconstruct the box better than templates of the background;
        and the box, without its rotation
        """
        grey = _grey(image)
        size = math.sqrt(self._box.area)
        moves = self._rng.normal(size=(self._particles, 5)) * _SPREAD * [size, size, 1, 1, 1]
        moves[0] = 0
        states = self._state + moves
        states[:, :2] = states[:, :2].clip(0, np.subtract(grey.size, 1))
        cuts = self._cuts(grey, states)
        best, confidence = self._most_likely(cuts)
        self._state = states[best]
        self._frames += 1
        if self._frames % _EVERY == 0:
            self._discriminative = _Discriminative.trained(self._discriminative.positives, self._background(grey))
            self._generative.update(cuts[best])
        return confidence / (1 + confidence), self._box

    @property
    def _box(self) -> Box:
        x, y, scale, aspect, _ = map(float, self._state)
        w, h = self._first.w * math.exp(scale + aspect), self._first.h * math.exp(scale - aspect)
        return Box(x - w / 2, y - h / 2, w, h)

    def _most_likely(self, cuts: np.ndarray) -> tuple[int, float]:
        """The candidate with the highest H L ("Collaborative Model"), and its H."""
        confidences = self._discriminative.confidences(cuts)
        best, highest = 0, 0.0
        for batch in np.array_split(np.argsort(-confidences, kind="stable"), max(len(cuts) // 20, 1)):
            if confidences[batch[0]] <= highest:
                break  # L is at most 1, so no other product is higher
            likelihoods = confidences[batch] * self._generative.similarities(cuts[batch])
            if likelihoods.max() > highest:
                best, highest = int(batch[likelihoods.argmax()]), float(likelihoods.max())
        return best, float(confidences[best])

    def _background(self, grey: Pyramid) -> np.ndarray:
        """Negative templates, from an annulus that includes the object's edge ("Templates")."""
        return self._cuts(grey, self._shifted(_NEGATIVES, 0.25, 0.5))

    def _shifted(self, count: int, min_shift: float, deviation: float) -> np.ndarray:
        """States shifted from the current one by more than a share of the box along x or along y."""
        shifts = self._rng.normal(scale=deviation, size=(8 * count, 2))
        states = np.tile(self._state, (count, 1))
        states[:, :2] += shifts[(abs(shifts) >= min_shift).any(axis=1)][:count] * self._box[2:]
        return states

    def _cuts(self, grey: Pyramid, states: np.ndarray) -> np.ndarray:
        """The patches of the frame at states, uint8 (count, 32, 32)."""
        across = self._first.w / _SIDE * np.exp(states[:, 2] + states[:, 3])
        down = self._first.h / _SIDE * np.exp(states[:, 2] - states[:, 3])
        cuts = zip(states[:, 0], states[:, 1], across, down, states[:, 4], strict=True)
        return np.array([grey.cut(x, y, w, h, _SIDE, angle)[0] for x, y, w, h, angle in cuts])


class _Discriminative:
    """A classifier of templates of object and background ("Sparsity-based Discriminative Classifier")."""

    _SELECTION = 0.001  # lambda of the regression
    _SIGMA = 0.4

    def __init__(self, positives: np.ndarray, templates: np.ndarray, selected: np.ndarray) -> None:
        self.positives, self.templates, self.selected = positives, templates, selected
        self._templates = templates[:, selected]

    @classmethod
    def trained(cls, positives: np.ndarray, negatives: np.ndarray) -> _Discriminative:
        """Select the pixels that discriminate positives from negatives."""
        templates = _unit(np.concatenate([positives, negatives]).reshape(-1, _SIDE * _SIDE))
        labels = np.repeat([1.0, -1.0], [len(positives), len(negatives)])
        # By a sparse regression of the labels ("Feature Selection").
        regression = Lasso(cls._SELECTION / len(labels), fit_intercept=False)
        with FILTERS, warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a thousand sweeps are enough
            weights = regression.fit(templates, labels).coef_
        return cls(positives, templates, np.flatnonzero(weights) if weights.any() else np.arange(_SIDE * _SIDE))

    def confidences(self, cuts: np.ndarray) -> np.ndarray:
        """H of the candidates: the ratio of the reconstruction errors by background and object."""
        rows = _unit(cuts.reshape(-1, _SIDE * _SIDE))[:, self.selected]
        codes = _codes(rows, self._templates)
        half = len(self.positives)
        foreground = _squares(rows - codes[:, :half] @ self._templates[:half])
        background = _squares(rows - codes[:, half:] @ self._templates[half:])
        ratios: np.ndarray = np.exp((background - foreground) / self._SIGMA)
        return ratios


class _Generative:
    """A histogram of sparse codes, patch by patch ("Sparsity-based Generative Model")."""

    _PATCH, _STRIDE, _ATOMS = 6, 2, 50
    _OCCLUDED = 0.04  # reconstruction error from which a patch is occluded
    _MAX_OCCLUSION = 0.8  # share of occluded patches from which the histogram is not updated
    _FIRST_SHARE = 0.95  # share of the first histogram

    def __init__(self, atoms: np.ndarray, first: np.ndarray, histogram: np.ndarray) -> None:
        self.atoms, self.first, self.histogram = atoms, first, histogram

    @classmethod
    def from_template(cls, template: np.ndarray, seed: int) -> _Generative:
        """Cluster the patches of the object."""
        patches = cls._patches(template[None])
        with FILTERS, warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a plain object has fewer than 50 different patches
            atoms = _unit(KMeans(cls._ATOMS, n_init=1, random_state=seed).fit(patches).cluster_centers_)
        self = cls(atoms, np.empty(0), np.empty(0))
        self.first = self.histogram = self._coded(template[None])[0][0]
        return self

    def similarities(self, cuts: np.ndarray) -> np.ndarray:
        """L of the candidates: the intersection with the object's histogram, without occluded patches."""
        codes, is_occluded = self._coded(cuts)
        codes[is_occluded] = 0
        shared = np.minimum(codes, self.histogram).sum(axis=(1, 2))
        shares: np.ndarray = shared / max(self.histogram.sum(), 1e-6)
        return shares

    def update(self, patch: np.ndarray) -> None:
        """Update the histogram unless the object is occluded; it retains a share of the first one ("Update Scheme")."""
        codes, is_occluded = self._coded(patch[None])
        if is_occluded.mean() < self._MAX_OCCLUSION:
            codes[is_occluded] = 0
            self.histogram = self._FIRST_SHARE * self.first + (1 - self._FIRST_SHARE) * codes[0]

    def _coded(self, cuts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Codes (count, 196, 50) of all patches, and a mask of the occluded ones (count, 196)."""
        patches = self._patches(cuts)
        codes = _codes(patches, self.atoms)
        is_occluded = _squares(patches - codes @ self.atoms) >= self._OCCLUDED
        return codes.reshape(len(cuts), -1, self._ATOMS), is_occluded.reshape(len(cuts), -1)

    @classmethod
    def _patches(cls, cuts: np.ndarray) -> np.ndarray:
        """Overlapping patches of unit length, float32 (count * 196, 36)."""
        views = sliding_window_view(cuts, (cls._PATCH, cls._PATCH), axis=(1, 2))
        return _unit(views[:, :: cls._STRIDE, :: cls._STRIDE].reshape(-1, cls._PATCH**2))


def _grey(image: np.ndarray) -> Pyramid:
    return Pyramid(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def _squares(rows: np.ndarray) -> np.ndarray:
    squares: np.ndarray = np.einsum("ij,ij->i", rows, rows)
    return squares


def _unit(rows: np.ndarray) -> np.ndarray:
    """Normalise rows to length 1, float32; a row of zeros stays zero."""
    rows = rows.astype(np.float32)
    unit: np.ndarray = rows / np.maximum(np.sqrt(_squares(rows)), 1e-6)[:, None]
    return unit


def _codes(rows: np.ndarray, atoms: np.ndarray) -> np.ndarray:
    """Non-negative sparse codes: minimise |row - code atoms|^2 / 2 + lambda |code|_1.

    `sklearn.decomposition.sparse_encode` computes the same, but a call takes 0.2 ms for each of the 58,800 patches of a
    frame, and coordinate descent needs 500 sweeps for patches that are so similar.

    Returns
    -------
    float32 (rows, atoms)
    """
    wide = atoms.astype(np.float64)
    codes = np.zeros((len(rows), len(atoms)), np.float32)
    sparse_codes(rows @ wide.T - _PENALTY, wide @ wide.T, codes)
    return codes

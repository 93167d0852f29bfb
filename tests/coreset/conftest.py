"""Streams of rows that the laws of the coreset are tried on."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from catstream.features.cells import Cells
from catstream.features.layout import CELL, MARGIN, WINDOW
from catstream.features.pyramid import planes_of

ROWS = 208  #: 13 leaves of 16: levels 3, 2 and 0


def random_rows(rng: np.random.Generator) -> np.ndarray:
    """Nothing in common: the hardest to summarise."""
    return rng.normal(size=(ROWS, 60)).astype(np.float32)


def low_rank_rows(rng: np.random.Generator) -> np.ndarray:
    """Five directions and a little noise: fewer than a node has rows."""
    rows = rng.normal(size=(ROWS, 5)) @ rng.normal(size=(5, 60)) + 0.01 * rng.normal(size=(ROWS, 60))
    return rows.astype(np.float32)


def hog_rows(rng: np.random.Generator) -> np.ndarray:
    """Real features: a textured object that drifts, turns, grows and changes light in a noisy video."""
    texture = cv2.resize(rng.integers(0, 255, (24, 24, 3), np.uint8), (240, 240), interpolation=cv2.INTER_CUBIC)
    side = (WINDOW + 2 * MARGIN) * CELL
    rows = []
    for frame in range(ROWS):
        turn = cv2.getRotationMatrix2D((120, 120), 20 * np.sin(frame / 30), 1 + 0.2 * np.sin(frame / 50))
        turn[:, 2] += 10 * np.sin([frame / 11, frame / 17]) - 120 + side / 2
        image = cv2.warpAffine(texture, turn, (side, side)) * (0.8 + 0.2 * np.cos(frame / 40))
        image = np.clip(image + rng.normal(scale=4, size=image.shape), 0, 255).astype(np.uint8)
        rows.append(Cells.within(planes_of(image)).row(0, 0))
    return np.array(rows)


@pytest.fixture(scope="session", params=[random_rows, low_rank_rows, hog_rows], ids=["random", "low_rank", "hog"])
def stream(request: pytest.FixtureRequest) -> np.ndarray:
    """Rows of each kind, float32 (208, d)."""
    return request.param(np.random.default_rng(5))


@pytest.fixture(scope="session")
def strongest(stream: np.ndarray) -> np.ndarray:
    """The stream's directions, strongest first, float64 (d, m)."""
    return np.linalg.svd(stream.astype(np.float64), full_matrices=False)[2].T


@pytest.fixture(params=[1, 4, 8], ids=lambda k: f"k={k}")
def subspaces(request: pytest.FixtureRequest, strongest: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Bases (d, k) of subspaces S: random ones, the best fit to the stream, and one of weak directions."""
    k = request.param
    random = [np.linalg.qr(rng.normal(size=(len(strongest), k)))[0] for _ in range(5)]
    return [*random, strongest[:, :k], strongest[:, 16 : 16 + k]]


@pytest.fixture
def squared_distance() -> Callable[[np.ndarray, np.ndarray], float]:
    """dist^2(A, S) = ||A Y||^2, where the columns of Y complete the basis (d, k) of S to one of all space."""

    def distance(rows: np.ndarray, basis: np.ndarray) -> float:
        rows = rows.astype(np.float64)
        return float(np.sum(rows**2) - np.sum((rows @ basis) ** 2))

    return distance

"""Laws of the similarity to an object."""

import numpy as np
import pytest

from catstream.coreset.reduce import energy, reduce
from catstream.detection.similarity import Similarity

WIDTH = 200


@pytest.fixture
def rows(rng):
    """Rows of an object: a mean and variations in ten directions, with a little noise."""
    mean, directions = 3 * rng.normal(size=WIDTH), rng.normal(size=(10, WIDTH))
    rows = mean + rng.normal(size=(120, 10)) @ directions + 0.3 * rng.normal(size=(120, WIDTH))
    return rows.astype(np.float32)


def similarity_of(coreset, rows, background):
    return Similarity.of(coreset, energy(rows), rows.sum(axis=0, dtype=np.float64), len(rows), background)


@pytest.fixture
def background(rng):
    return rng.normal(size=WIDTH).astype(np.float32)


def test_mean_similarity_weighted_by_energy_is_one(rows, background):
    similarity = similarity_of(rows, rows, background)
    weights = ((rows - background) ** 2).sum(axis=1)
    assert np.average([similarity(row) for row in rows], weights=weights) == pytest.approx(1, abs=1e-4)


def test_similarity_of_random_rows_is_low(rows, background, rng):
    similarity = similarity_of(rows, rows, background)
    assert max(similarity(background + 9 * rng.normal(size=WIDTH)) for _ in range(50)) < 0.3


def test_coreset_gives_the_similarity_of_all_rows(rows, background, rng):
    whole, small = similarity_of(rows, rows, background), similarity_of(reduce(rows, 40), rows, background)
    others = background + 9 * rng.normal(size=(20, WIDTH))
    for row in (*rows[:20], *others):
        assert small(row) == pytest.approx(whole(row), abs=0.02)


def test_similarity_of_the_background_is_zero(rows, background):
    assert similarity_of(rows, rows, background)(background) == 0

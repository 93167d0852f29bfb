"""Laws of the frequent-directions sketch: one node of n rows, and an error of at most c / (n + 1) in each direction.

Let A be all rows, C the rows in memory, s_i the singular values of A, and c = ||A||^2 - ||C||^2. For every unit vector
y and every k <= n (Ghashami et al. 2016),

    0 <= ||A y||^2 - ||C y||^2 <= c / (n + 1) <= ||A||^2 / (n + 1),   and
    max_y (||A y||^2 - ||C y||^2) <= (s_(k+1)^2 + s_(k+2)^2 + ...) / (n + 1 - k).
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from catstream.coreset.reduce import energy, shrink
from catstream.coreset.tree import CoresetTree, FrequentDirections
from catstream.errors import ProtocolError
from tests.learning import rows_of

SIZE = 16
ROUNDING = 1e-5  # of float32, relative to ||A||^2


def sketched(rows: np.ndarray) -> FrequentDirections:
    sketch = FrequentDirections(SIZE)
    sketch.insert(rows)
    return sketch


def assert_within_the_bound(sketch: FrequentDirections, rows: np.ndarray) -> None:
    kept, slack = rows_of(sketch), ROUNDING * energy(rows)
    exact = rows.astype(np.float64)
    _, lengths, basis = np.linalg.svd(exact, full_matrices=False)
    kept = kept.astype(np.float64) @ basis.T  # in the span of A, which has all rows of C
    errors = np.linalg.eigvalsh(np.diag(lengths**2) - kept.T @ kept)  # the least and the largest are of unit vectors y
    assert -slack <= errors[0]
    assert errors[-1] <= sketch.dropped_energy / (SIZE + 1) + slack
    assert sketch.dropped_energy <= energy(rows) * (1 + ROUNDING)
    squares = lengths**2
    assert errors[-1] <= min(squares[k:].sum() / (SIZE + 1 - k) for k in range(SIZE + 1)) + slack


def test_the_error_of_each_direction_stays_within_the_bound(stream):
    assert_within_the_bound(sketched(stream), stream)


def test_two_sketches_merged_are_one_sketch_within_the_bound(stream):
    sketch = sketched(stream[:75]).merged(sketched(stream[75:]))
    assert (sketch.rows_seen, len(sketch.nodes)) == (len(stream), 1)
    assert_allclose(sketch.sum, stream.sum(axis=0, dtype=np.float64), atol=ROUNDING * len(stream))
    assert_within_the_bound(sketch, stream)


def test_memory_does_not_grow_with_the_rows(rng):
    sketch, sizes = FrequentDirections(4), set()
    for _ in range(300):
        sketch.insert(rng.normal(size=(4, 7)))
        sizes.add(sketch.nbytes)
    assert len(sizes) == 1


def test_state_with_a_wrong_count_is_an_error(stream):
    arrays, metadata = sketched(stream).state()
    metadata["nodes"][0]["count"] += 1
    with pytest.raises(ProtocolError, match="not the state of a coreset tree"):
        FrequentDirections.from_state(arrays, metadata)


def test_a_sketch_and_a_tree_are_not_merged(stream):
    tree = CoresetTree(SIZE)
    tree.insert(stream)
    with pytest.raises(ProtocolError, match="a CoresetTree cannot merge a FrequentDirections"):
        tree.merged(sketched(stream))


@given(st.integers(0, 2**32 - 1), st.integers(1, 7))
def test_shrinking_takes_the_same_energy_from_each_direction(seed, size):
    rows = np.random.default_rng(seed).normal(size=(8, 12)).astype(np.float32)
    squares = np.linalg.svd(rows.astype(np.float64), compute_uv=False) ** 2
    kept = np.sum(shrink(rows, size).astype(np.float64) ** 2, axis=1)
    assert_allclose(kept, squares[:size] - squares[size], atol=ROUNDING * energy(rows))

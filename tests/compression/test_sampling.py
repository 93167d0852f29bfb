"""Laws of the hierarchical sample (paper, section "Coreset Appearance Model")."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from catstream.compression.node import sample, spread
from catstream.compression.reduce import reduce
from catstream.compression.tree import CoresetTree

SIZE = 16


def grown(rows: np.ndarray, size: int = SIZE) -> CoresetTree:
    tree = CoresetTree(size)
    tree.insert(rows)
    return tree


@given(st.integers(0, 600), st.sampled_from([1, 2, 5, 16]))
def test_a_sample_has_at_most_2n_rows(count, size):
    summary = grown(np.ones((count, 3)), size).sample()
    assert len(summary.rows) <= 2 * size
    assert len(summary.rows) >= size or count < size


def test_a_node_gives_its_strongest_n_rows_times_2_to_the_level_below_the_top(stream):
    tree = grown(stream)
    rows, start = sample(tree.nodes, SIZE), 0
    assert [node.level for node in tree.nodes] == [3, 2, 0]
    for node, taken in zip(tree.nodes, [16, 8, 2], strict=True):
        part = rows[start : start + taken].astype(np.float64)
        _, strengths, directions = np.linalg.svd(node.rows.astype(np.float64), full_matrices=False)
        first = (strengths[:, None] * directions)[:taken] * np.sqrt(taken / node.count)
        # Equal up to a left rotation: the same distances to every subspace.
        assert_allclose(part.T @ part, first.T @ first, atol=1e-5 * np.sum(first**2))
        start += taken
    assert start == len(rows)


def test_each_row_weighs_one_original_row(rng):
    """A stream of one row again and again is sampled as that row, whatever its age."""
    row = rng.uniform(size=30).astype(np.float32)
    rows = grown(np.tile(row, (SIZE * 13, 1))).sample().rows
    assert_allclose(rows, np.tile(row, (len(rows), 1)), rtol=1e-4)


@given(st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_spreading_is_a_rotation(count, seed):
    rows = reduce(np.random.default_rng(seed).normal(size=(count, 12)).astype(np.float32), count)
    turned = rows.copy()
    spread(turned)
    assert_allclose(turned.T @ turned, rows.T @ rows, atol=1e-4)
    assert_allclose(turned @ rows[0], np.full(count, rows[0] @ rows[0] / np.sqrt(count)), atol=1e-3)


def test_means_and_counts_are_those_of_all_rows_pending_ones_too(stream):
    rows = stream[:205]
    summary = grown(rows).sample()
    assert summary.count == 205
    assert_allclose(summary.mean, rows.mean(axis=0, dtype=np.float64), rtol=1e-6, atol=1e-7)
    assert summary.levels == (3, 2)


@given(st.lists(st.integers(0, 40), max_size=12), st.integers(0, 2**32 - 1))
def test_a_sample_after_many_others_is_that_of_a_tree_that_made_none(cuts, seed):
    rows = np.random.default_rng(seed).normal(size=(sum(cuts), 9)).astype(np.float32)
    tree, start = CoresetTree(4), 0
    for count in cuts:
        tree.insert(rows[start : start + count])
        start += count
        assert_array_equal(tree.sample().rows, grown(rows[:start], size=4).sample().rows)

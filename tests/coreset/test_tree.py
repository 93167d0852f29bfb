"""Laws of the coreset tree, and of its hierarchical sample (paper, section "Coreset Appearance Model").

A node's error, ||C Y||^2 + c - ||A Y||^2, is the sum of its two children's and that of their
reduction, which `test_reduce.py` bounds by epsilon ||A Y||^2, epsilon = k / (n - k + 1). Leaves
have none, so that at level q, with all errors adding up and none negative,

    ||A Y||^2 <= ||C Y||^2 + c <= (1 + q epsilon) ||A Y||^2   and   ||A Y||^2 - c <= ||C Y||^2 <= ||A Y||^2.

The first is sharper than the (1 + epsilon)^q of the paper (section "Coreset Tree").
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from catstream.coreset.node import sample
from catstream.coreset.reduce import energy
from catstream.coreset.tree import CoresetTree, FrequentDirections
from catstream.errors import ProtocolError
from tests.learning import rows_of

SIZE = 16
ROUNDING = 1e-5  # of float32, relative to ||A||^2

counts = st.integers(0, 90)
seeds = st.integers(0, 2**32 - 1)
KINDS = pytest.mark.parametrize("kind", [CoresetTree, FrequentDirections])


def grown(rows: np.ndarray, size: int = SIZE, kind: type[CoresetTree] = CoresetTree) -> CoresetTree:
    tree = kind(size)
    tree.insert(rows)
    return tree


def whole_numbers(count: int, seed: int) -> np.ndarray:
    """Rows whose sums are exact in any order."""
    return np.random.default_rng(seed).integers(-9, 10, (count, 6)).astype(np.float32)


def bits(tree: CoresetTree) -> dict[str, bytes]:
    arrays, metadata = tree.state()
    return {"metadata": repr(metadata).encode()} | {name: array.tobytes() for name, array in arrays.items()}


def assert_within_the_bound(tree, rows, subspaces, squared_distance):
    """Distances are within the bound; kept and dropped energy add up to all of it."""
    levels, dropped, slack = tree.nodes[0].level, tree.dropped_energy, ROUNDING * energy(rows)
    for basis in subspaces:
        k = basis.shape[1]
        truth, approximation = squared_distance(rows, basis), squared_distance(rows_of(tree), basis)
        assert truth - dropped - slack <= approximation <= truth + slack
        assert truth - slack <= approximation + dropped <= (1 + levels * k / (SIZE - k + 1)) * truth + slack
    assert tree.rows_seen == len(rows)
    assert_allclose(energy(rows_of(tree)) + dropped, energy(rows), rtol=1e-12)


def test_distances_to_subspaces_stay_within_the_bound(stream, subspaces, squared_distance):
    assert_within_the_bound(grown(stream), stream, subspaces, squared_distance)


def test_equal_rows_lose_no_energy(rng):
    """Equal rows make a Gram matrix of equal eigenvalues, on which less careful solvers fail."""
    rows = np.tile(rng.uniform(size=30), (SIZE * 32, 1)).astype(np.float32)
    tree = grown(rows)
    assert_allclose(tree.dropped_energy, 0, atol=ROUNDING * energy(rows))
    assert_allclose(tree.nodes[0].rows[0], np.sqrt(len(rows)) * rows[0], rtol=ROUNDING)


@KINDS
@given(counts, seeds)
def test_sums_counts_and_leaves_are_exact(kind, count, seed):
    rows = whole_numbers(count, seed)
    tree = grown(rows, 4, kind)
    assert (tree.rows_seen, tree.leaves) == (count, count // 4)
    assert_array_equal(tree.sum, rows.sum(axis=0, dtype=np.float64) if count else 0)


@given(st.integers(0, 300), seeds)
def test_levels_strictly_fall_from_oldest_to_newest(count, seed):
    levels = [node.level for node in grown(whole_numbers(count, seed), size=4).nodes]
    assert levels == sorted(set(levels), reverse=True)
    assert sum(4 << level for level in levels) == count - count % 4


def test_memory_grows_with_the_logarithm_of_the_rows(rng):
    n, d = 4, 7
    tree = CoresetTree(n)
    for p in range(1, 1500):
        tree.insert(rng.normal(size=(1, d)))
        nodes = math.log2(p / n) + 1 if p >= n else 0
        assert len(tree.nodes) <= nodes
        assert tree.nbytes <= nodes * (4 * n * d + 8 * d) + 4 * n * d


@KINDS
@given(st.lists(st.integers(0, 20), max_size=12), seeds)
def test_rows_in_parts_give_the_same_bits(kind, cuts, seed):
    rows = np.random.default_rng(seed).normal(size=(sum(cuts), 33)).astype(np.float32)
    tree = kind(4)
    for part in np.split(rows, np.cumsum(cuts)):
        tree.insert(part)
    assert bits(tree) == bits(grown(rows, 4, kind))


def test_tree_holds_no_reference_to_inserted_rows(stream):
    rows = stream.copy()
    tree, other = grown(rows[:50]), grown(stream[:50])
    rows[:] = 0
    assert bits(tree) == bits(other)


@pytest.mark.parametrize(("merged", "end"), [(75, 208), (50, 90)], ids=["the rest", "a part"])
def test_two_trees_merged_are_one_tree_within_the_bound(stream, subspaces, squared_distance, merged, end):
    tree = grown(stream[:merged]).merged(grown(stream[merged:end]))
    tree.insert(stream[end:])
    assert_within_the_bound(tree, stream, subspaces, squared_distance)


@given(counts, counts, seeds)
def test_merging_keeps_the_form_of_a_tree(count, other_count, seed):
    rows, others = whole_numbers(count, seed), whole_numbers(other_count, seed + 1)
    one, other = grown(rows, size=4), grown(others, size=4)
    before = bits(one), bits(other)
    tree = one.merged(other)
    levels = [node.level for node in tree.nodes]
    assert levels == [node.level for node in grown(np.vstack([rows, others]), size=4).nodes]
    assert_array_equal(tree.sum, np.vstack([rows, others]).sum(axis=0) if count + other_count else 0)
    assert (bits(one), bits(other)) == before


@KINDS
@pytest.mark.parametrize("count", [0, 3, 64, 103])
def test_saved_tree_continues_bit_for_bit(stream, count, kind):
    tree = grown(stream[:count], kind=kind)
    loaded = kind.from_state(*tree.state())
    for each in (tree, loaded):
        each.insert(stream[count:])
    assert bits(loaded) == bits(tree)


@KINDS
def test_interrupted_reduction_loses_no_node(stream, kind, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    tree = grown(stream[: 3 * SIZE], kind=kind)
    before = bits(tree)
    monkeypatch.setattr(kind, "_merged", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tree.insert(stream[:SIZE])
    assert bits(tree) == before


@KINDS
@pytest.mark.parametrize("width", [1, SIZE - 1, SIZE, 2 * SIZE - 1])
def test_rows_shorter_than_a_reduction_stay_within_the_bound(kind, width, rng):
    rows = rng.normal(size=(40 * SIZE + 3, width)).astype(np.float32)
    tree, slack = grown(rows, kind=kind), ROUNDING * energy(rows)
    errors = np.linalg.eigvalsh(rows.T.astype(np.float64) @ rows - tree.rows.T.astype(np.float64) @ tree.rows)
    assert -slack <= errors[0]
    assert errors.clip(min=0).sum() <= tree.dropped_energy + slack
    assert width > SIZE or 0 <= tree.dropped_energy <= slack


@pytest.mark.parametrize(
    "rows",
    [np.ones((3, 5)), np.ones(6), np.full((2, 6), np.nan), np.full((2, 6), np.inf)],
    ids=["longer", "flat", "nan", "inf"],
)
def test_invalid_rows_are_an_error_and_change_nothing(rows):
    tree = grown(whole_numbers(14, seed=1), size=4)
    before = bits(tree)
    with pytest.raises(ProtocolError, match=r"expected rows float32 \(k, 6\)|insert finite rows"):
        tree.insert(rows)
    assert bits(tree) == before


def test_trees_of_other_sizes_or_lengths_are_not_merged():
    tree = grown(np.ones((9, 6)), size=4)
    with pytest.raises(ProtocolError, match=r"size 4 .* size 5"):
        tree.merged(grown(np.ones((9, 6)), size=5))
    with pytest.raises(ProtocolError, match=r"length 6 .* length 7"):
        tree.merged(grown(np.ones((9, 7)), size=4))


@given(st.integers(0, 600), st.sampled_from([1, 2, 5, 16]))
def test_a_sample_has_at_most_2n_rows(count, size):
    summary = grown(np.ones((count, 3)), size).sample()
    assert len(summary.rows) <= 2 * size
    assert len(summary.rows) >= size or count < size


def test_sample_has_half_as_many_rows_of_each_lower_level(stream):
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


def test_mean_and_count_of_a_sample_include_pending_rows(stream):
    rows = stream[:205]
    summary = grown(rows).sample()
    assert summary.count == 205
    assert_allclose(summary.mean, rows.mean(axis=0, dtype=np.float64), rtol=1e-6, atol=1e-7)
    assert summary.levels == (3, 2)


@given(st.lists(st.integers(0, 40), max_size=12), st.integers(0, 2**32 - 1))
def test_sample_does_not_depend_on_earlier_samples(cuts, seed):
    rows = np.random.default_rng(seed).normal(size=(sum(cuts), 9)).astype(np.float32)
    tree, start = CoresetTree(4), 0
    for count in cuts:
        tree.insert(rows[start : start + count])
        start += count
        assert_array_equal(tree.sample().rows, grown(rows[:start], size=4).sample().rows)

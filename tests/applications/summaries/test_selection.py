"""Laws of the selection of k rows of a stream: the energy that they keep, its certificate, and constant memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from catstream.applications.summaries.selection import RowSelection, Selection, choose, exchange
from catstream.errors import SettingsError

ROUNDING = 1e-5  # of float32

seeds = st.integers(0, 2**32 - 1)


def kept(rows: np.ndarray, numbers: list[int]) -> float:
    """||A P||^2 / ||A||^2, with P the projection on the span of some rows."""
    exact = rows.astype(np.float64)
    directions, lengths, _ = np.linalg.svd(exact[numbers].T, full_matrices=False)
    basis = directions[:, lengths > 1e-6 * lengths[0]]
    return float(np.sum((exact @ basis) ** 2) / np.sum(exact**2))


def selected(rows: np.ndarray, k: int, size: int | None = None) -> Selection[int]:
    selection = RowSelection[int](k, size)
    for number, row in enumerate(rows):
        selection.add(row, number)
    return selection.result()


@pytest.mark.parametrize("k", [1, 4, 10])
def test_the_energy_kept_lies_within_the_certificate(rows, k):
    selection = selected(rows, k, size=20)  # reduced five times
    truth = kept(rows, selection.selected)
    assert selection.kept - ROUNDING <= truth <= selection.kept_at_most + ROUNDING
    assert_allclose(sum(selection.energies), selection.kept)


@pytest.mark.parametrize("k", [2, 6, 12])
def test_one_pass_keeps_nearly_as_much_as_the_greedy_choice_from_all_rows_and_more_than_random(rows, k, rng):
    gram = rows.astype(np.float64) @ rows.T.astype(np.float64)
    greedy = kept(rows, choose(gram, gram, k)[0])
    random = np.mean([kept(rows, rng.choice(len(rows), k, replace=False).tolist()) for _ in range(10)])
    ours = kept(rows, selected(rows, k, size=24).selected)
    assert ours > random
    assert ours > greedy - 0.1 * (greedy - random)


def test_memory_does_not_grow_with_the_stream(rng):
    def most(count: int) -> int:
        selection = RowSelection[int](2, size=8)
        tracemalloc.start()
        for number in range(count):
            selection.add(rng.normal(size=500), number)
        selection.result()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    most(20)  # imports
    assert most(800) < 1.1 * most(100)


def test_a_row_of_each_group_is_selected(rng):
    directions = np.linalg.qr(rng.normal(size=(40, 5)))[0].T
    groups = rng.integers(0, 5, 300)
    rows = directions[groups] + 0.01 * rng.normal(size=(300, 40))
    assert sorted(groups[selected(rows, 5, size=16).selected]) == [0, 1, 2, 3, 4]


def test_energies_fall_and_the_stream_may_continue(rows):
    selection = RowSelection[int](5, size=16)
    for number, row in enumerate(rows):
        selection.add(row, number)
        if number in (40, 77):
            early = selection.result()
            assert early.count == number + 1
            assert max(early.selected) <= number
    energies = selection.result().energies
    assert energies == sorted(energies, reverse=True)
    assert selection.result() == selection.result()


def test_equal_rows_complete_the_number_with_no_energy():
    selection = selected(np.ones((40, 6)), 3, size=4)
    assert len(set(selection.selected)) == 3
    assert_allclose(selection.energies, [1, 0, 0], atol=ROUNDING)


def test_rows_without_energy_can_be_selected():
    assert len(selected(np.zeros((9, 6)), 2, size=4).selected) == 2


@given(seeds, st.integers(1, 6))
def test_an_exchange_never_loses_energy(seed, k):
    rows = np.random.default_rng(seed).normal(size=(25, 12))
    gram = rows @ rows.T
    chosen = choose(gram, gram, k)[0]
    exchanged = exchange(gram, gram, chosen)
    assert len(set(exchanged)) == len(chosen)
    assert kept(rows, exchanged) >= kept(rows, chosen) - 1e-9


@given(seeds)
def test_the_greedy_energies_are_those_of_the_projections(seed):
    rows = np.random.default_rng(seed).normal(size=(15, 8))
    gram = rows @ rows.T
    chosen, energies = choose(gram, gram, 4)
    assert_allclose(np.cumsum(energies) / gram.trace(), [kept(rows, chosen[: n + 1]) for n in range(4)])


def test_more_rows_than_there_are_is_an_error():
    with pytest.raises(SettingsError, match=r"k = 4 images cannot be selected from 3: give a smaller k"):
        selected(np.eye(3), 4)
    with pytest.raises(SettingsError, match="got 0"):
        RowSelection[int](0)

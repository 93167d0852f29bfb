"""Laws of one reduction, 2n rows to n.

With A = U S V', the kept rows are C = S_n V_n', so that A'A - C'C = sum of s_i^2 v_i v_i' over the
dropped directions i > n, which has no negative eigenvalue. For orthonormal Y (d, d - k):

    0 <= ||A Y||^2 - ||C Y||^2 <= c        with c = sum of s_i^2, i > n, its trace,

and ||C Y||^2 + c - ||A Y||^2 is the dropped energy inside the k directions that Y leaves out,
at most that of the k strongest dropped ones. These are no stronger than s_(n+1)^2, while
||A Y||^2 holds at least s_(k+1)^2 + ... + s_(n+1)^2, n - k + 1 directions no weaker. So

    ||A Y||^2 <= ||C Y||^2 + c <= (1 + k / (n - k + 1)) ||A Y||^2,

a (1 + epsilon) coreset in the paper's sense (section "Coresets") with epsilon = k / (n - k + 1).
"""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal

from catstream.coreset.reduce import energy, reduce

SIZE = 16
ROUNDING = 1e-5  # of float32, relative to ||A||^2

matrices = arrays(
    np.float32, st.tuples(st.integers(1, 12), st.integers(1, 20)), elements=st.floats(-100, 100, width=32)
)


def test_distances_to_subspaces_stay_within_the_bound(stream, subspaces, squared_distance):
    rows = stream[: 2 * SIZE]
    kept = reduce(rows, SIZE)
    dropped = energy(rows) - energy(kept)
    for basis in subspaces:
        k = basis.shape[1]
        truth, summary = squared_distance(rows, basis), squared_distance(kept, basis)
        slack = ROUNDING * energy(rows)
        assert -slack <= truth - summary <= dropped + slack
        assert truth - slack <= summary + dropped <= (1 + k / (SIZE - k + 1)) * truth + slack


def test_no_other_rows_keep_more_energy(stream):
    rows = stream[: 2 * SIZE]
    best = np.sum(np.linalg.svd(rows.astype(np.float64), compute_uv=False)[:SIZE] ** 2)
    assert_allclose(energy(reduce(rows, SIZE)), best, rtol=1e-6)


@given(matrices, st.integers(1, 14))
def test_rows_are_orthogonal_and_the_strongest_is_first(rows, size):
    kept = reduce(rows, size).astype(np.float64)
    gram, slack = kept @ kept.T, ROUNDING * energy(rows) + 1e-30
    assert kept.shape == (min(size, len(rows)), rows.shape[1])
    assert_allclose(gram, np.diag(np.diag(gram)), atol=slack)
    assert np.all(np.diff(np.diag(gram)) <= slack)


@given(matrices, st.integers(1, 14))
def test_every_direction_points_towards_the_sum(rows, size):
    assert np.all(reduce(rows, size) @ rows.sum(axis=0) >= -ROUNDING * energy(rows) - 1e-30)


def test_the_sign_of_a_direction_follows_the_given_vector(rng):
    rows = rng.normal(size=(8, 5)).astype(np.float32)
    there, back = reduce(rows, 4, towards=np.ones(5)), reduce(rows, 4, towards=-np.ones(5))
    assert_array_equal(there, -back)

"""Closed forms, against the textbook's d x d systems."""

import numpy as np

from catstream.base import ridge


def test_between_is_the_solution_of_the_large_system(rng):
    background, towards = rng.normal(size=(30, 12)).astype(np.float32), rng.normal(size=12).astype(np.float32)
    system = np.cov(background, rowvar=False, bias=True) + 0.7 * np.eye(12)
    np.testing.assert_allclose(
        ridge.discriminant(background, towards, 0.7), np.linalg.solve(system, towards), rtol=1e-4
    )


def test_fit_minimises_the_squared_error(rng):
    x, y = rng.normal(size=(40, 9)), rng.normal(size=40)
    wide = np.column_stack([x, np.ones(40), y]).astype(np.float32)
    centred = x - x.mean(axis=0)
    system = centred.T @ centred / 40 + 0.3 * np.eye(9)
    expected = np.linalg.solve(system, centred.T @ (y - y.mean()) / 40)
    np.testing.assert_allclose(ridge.Regression(wide[:, :-1]).fit(wide[:, -1], 0.3)[0], expected, rtol=1e-3, atol=1e-5)


def test_fit_is_the_same_for_every_left_rotation(rng):
    rows = rng.normal(size=(25, 8)).astype(np.float32)
    rotation = np.linalg.qr(rng.normal(size=(25, 25)))[0].astype(np.float32)
    turned, expected = (ridge.Regression(each[:, :-1]).fit(each[:, -1], 0.2)[0] for each in (rotation @ rows, rows))
    np.testing.assert_allclose(turned, expected, rtol=1e-2, atol=1e-4)

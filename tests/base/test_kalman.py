"""The Kalman filter, against filterpy."""

import numpy as np
from filterpy import kalman as filterpy

from catstream.base import kalman


def test_both_steps_are_those_of_filterpy_bit_for_bit(rng):
    for size in np.geomspace(1e-3, 1e3, 100):
        state, process, observation = (
            root @ root.T for root in (size * rng.normal(size=(4, 4)), rng.normal(size=(4, 4)), rng.normal(size=(2, 2)))
        )
        mean, centre = 100 * rng.normal(size=4), 100 * rng.normal(size=2)
        predicted = kalman.predict(mean, state, kalman.TRANSITION, process)
        updated = kalman.update(mean, state, centre, observation)
        np.testing.assert_equal(predicted, filterpy.predict(mean, state, kalman.TRANSITION, process))
        np.testing.assert_equal(updated, filterpy.update(mean, state, centre, observation, kalman.OBSERVATION))

"""Where the object will be: a Kalman filter of its centre (paper, "Classification").

The detector's part. Its covariances are learned by the trainer and come with the model.
"""

from __future__ import annotations

import numpy as np

from catstream.kalman import TRANSITION, constant_velocity
from catstream.messages import Motion

__all__ = ["CentreFilter"]

_COASTING = TRANSITION @ np.diag([1, 1, 0.8, 0.8])  # out of sight: 0.8 + 0.8**2 + ... = 4 frames' way, then rest
_JUMP = 6.0  # standard deviations beyond which a measured centre is no motion, but another place
_UNKNOWN_SPEED = 100.0  # variance of a velocity not seen yet, in pushes of a frame


class CentreFilter:
    """Follows a centre through noise and absence, in constant time a frame.

    While the object is present it moves at constant velocity, but for the pushes that
    `motion` allows. While it is absent it coasts to a stop and grows less certain: no
    prediction runs away. A centre that the motion all but rules out, found again
    elsewhere, is a new start at rest, and no motion to be smoothed.

    Call `predict`, then `update`, once a frame.

    Parameters
    ----------
    motion : what the trainer learned
    centre : x and y in pixels, in the frame before the first that is predicted

    >>> motion = Motion(np.eye(4), np.eye(2))
    >>> centre = CentreFilter(motion, (10, 20))
    >>> for x in range(13, 100, 3):
    ...     _ = centre.predict()
    ...     centre.update((x, 20))
    >>> [round(value, 3) for value in centre.predict()]
    [100.0, 20.0]
    """

    def __init__(self, motion: Motion, centre: tuple[float, float]) -> None:
        self._motion, self._seen = motion, True
        self._kalman = constant_velocity(*_at_rest(centre, motion), motion.process, motion.observation)

    @property
    def motion(self) -> Motion:
        """The covariances it goes by."""
        return self._motion

    @property
    def state(self) -> np.ndarray:
        """Mean above covariance, float64 (5, 4): with `motion`, all that it knows."""
        return np.vstack([self._kalman.x, self._kalman.P])

    @classmethod
    def resumed(cls, motion: Motion, state: np.ndarray, seen: bool) -> CentreFilter:
        """A filter that goes on from another one's state, bit for bit; `seen` as the object was in its last frame."""
        self = cls(motion, (0.0, 0.0))
        self._kalman.x, self._kalman.P, self._seen = state[0], state[1:], seen
        return self

    @property
    def centre(self) -> tuple[float, float]:
        """Best estimate of x and y, in pixels."""
        return float(self._kalman.x[0]), float(self._kalman.x[1])

    @property
    def velocity(self) -> tuple[float, float]:
        """Best estimate of the way along x and y, in pixels a frame."""
        return float(self._kalman.x[2]), float(self._kalman.x[3])

    @property
    def deviation(self) -> float:
        """Standard deviation of the centre along its less certain direction, in pixels."""
        return float(np.sqrt(np.linalg.eigvalsh(self._kalman.P[:2, :2])[-1]))

    def predict(self) -> tuple[float, float]:
        """Go on by a frame: the centre to expect in it."""
        self._kalman.predict(F=TRANSITION if self._seen else _COASTING)
        return self.centre

    def update(self, centre: tuple[float, float] | None) -> None:
        """Take in the centre that was measured in this frame, None where the object is absent."""
        self._seen = centre is not None
        if centre is None:
            return
        self._kalman.update(np.array(centre))
        if self._kalman.mahalanobis > _JUMP:
            self._kalman.x, self._kalman.P = _at_rest(centre, self._motion)

    def adopt(self, motion: Motion) -> None:
        """Go on from here with other covariances."""
        self._motion = motion
        self._kalman.Q, self._kalman.R = motion.process, motion.observation


def _at_rest(centre: tuple[float, float], motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """State of an object that was only just seen, and its covariance."""
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = motion.observation
    covariance[2:, 2:] = _UNKNOWN_SPEED * motion.process[2:, 2:]
    return np.array([*centre, 0.0, 0.0]), covariance

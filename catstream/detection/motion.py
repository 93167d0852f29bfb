"""Where the object will be: a Kalman filter of its centre (paper, "Classification").

The detector's part. Its covariances are learned by the trainer and come with the model.
"""

from __future__ import annotations

import numpy as np

from catstream.messages import Motion

__all__ = ["CentreFilter"]

_TRANSITION = np.eye(4) + np.eye(4, k=2)  # (x, y, vx, vy): each position moves on by its velocity
_COASTING = _TRANSITION @ np.diag([1, 1, 0.8, 0.8])  # out of sight: 0.8 + 0.8**2 + ... = 4 frames' way, then rest
_OBSERVED = np.eye(2, 4)  # of which x and y are measured
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
        self._mean, self._covariance = np.empty(4), np.empty((4, 4))
        self.adopt(motion)
        self._start(centre)

    @property
    def motion(self) -> Motion:
        """The covariances it goes by."""
        return self._motion

    @property
    def state(self) -> np.ndarray:
        """Mean above covariance, float64 (5, 4): with `motion`, all that it knows."""
        return np.vstack([self._mean, self._covariance])

    @classmethod
    def resumed(cls, motion: Motion, state: np.ndarray, seen: bool) -> CentreFilter:
        """A filter that goes on from another one's state, bit for bit; `seen` as the object was in its last frame."""
        self = cls(motion, (0.0, 0.0))
        self._mean, self._covariance, self._seen = state[0], state[1:], seen
        return self

    @property
    def centre(self) -> tuple[float, float]:
        """Best estimate of x and y, in pixels."""
        return float(self._mean[0]), float(self._mean[1])

    @property
    def velocity(self) -> tuple[float, float]:
        """Best estimate of the way along x and y, in pixels a frame."""
        return float(self._mean[2]), float(self._mean[3])

    @property
    def deviation(self) -> float:
        """Standard deviation of the centre along its less certain direction, in pixels."""
        return float(np.sqrt(np.linalg.eigvalsh(self._covariance[:2, :2])[-1]))

    def predict(self) -> tuple[float, float]:
        """Go on by a frame: the centre to expect in it."""
        transition = _TRANSITION if self._seen else _COASTING
        self._mean = transition @ self._mean
        self._covariance = transition @ self._covariance @ transition.T + self._motion.process
        return self.centre

    def update(self, centre: tuple[float, float] | None) -> None:
        """Take in the centre that was measured in this frame, None where the object is absent."""
        self._seen = centre is not None
        if centre is None:
            return
        noise = self._motion.observation
        error = np.array(centre) - _OBSERVED @ self._mean
        shared = self._covariance @ _OBSERVED.T
        inverse = np.linalg.inv(_OBSERVED @ shared + noise)
        if np.sqrt(error @ inverse @ error) > _JUMP:
            self._start(centre)
            return
        gain = shared @ inverse
        left = np.eye(4) - gain @ _OBSERVED
        self._mean = self._mean + gain @ error
        # Joseph's form: it stays symmetric and positive.
        self._covariance = left @ self._covariance @ left.T + gain @ noise @ gain.T

    def adopt(self, motion: Motion) -> None:
        """Go on from here with other covariances."""
        self._motion = motion

    def _start(self, centre: tuple[float, float]) -> None:
        self._seen = True
        self._mean = np.array([*centre, 0.0, 0.0])
        self._covariance = np.zeros((4, 4))
        self._covariance[:2, :2] = self._motion.observation
        self._covariance[2:, 2:] = _UNKNOWN_SPEED * self._motion.process[2:, 2:]

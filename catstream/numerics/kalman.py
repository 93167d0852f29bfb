"""The motion of a centre: a Kalman filter of filterpy, with the matrices of constant velocity.

The state is (x, y, vx, vy), in pixels and pixels a frame; x and y are measured. The detector filters with it, and the
trainer smooths with it.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import SourceFileLoader
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from filterpy.kalman import KalmanFilter

TRANSITION = np.eye(4) + np.eye(4, k=2)  #: each position moves on by its velocity
OBSERVED = np.eye(2, 4)  #: of the state, x and y are measured


def constant_velocity(
    mean: np.ndarray, covariance: np.ndarray, process: np.ndarray, observation: np.ndarray
) -> KalmanFilter:
    """A Kalman filter of a centre that moves at constant velocity, but for random changes of its state.

    Parameters
    ----------
    mean : float64 (4,), the state
    covariance : float64 (4, 4), of the state
    process : float64 (4, 4), covariance of the change of the state in a frame
    observation : float64 (2, 2), covariance of the error of a measured centre

    >>> kalman = constant_velocity(np.array([10.0, 20, 3, 0]), np.eye(4), np.eye(4), np.eye(2))
    >>> kalman.predict()
    >>> kalman.x
    array([13., 20.,  3.,  0.])
    """
    kalman: KalmanFilter = _filterpy.KalmanFilter(dim_x=4, dim_z=2)
    kalman.F, kalman.H = TRANSITION, OBSERVED
    kalman.x, kalman.P, kalman.Q, kalman.R = mean, covariance, process, observation
    return kalman


def predicted(
    mean: np.ndarray, covariance: np.ndarray, transition: np.ndarray, process: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the state in the next frame, without the working space of a filter's object."""
    mean, covariance = _filterpy.predict(mean, covariance, transition, process)
    return mean, covariance


def updated(
    mean: np.ndarray, covariance: np.ndarray, measured: np.ndarray, observation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the state after a measurement of x and y, float64 (2,)."""
    mean, covariance = _filterpy.update(mean, covariance, measured, observation, OBSERVED)
    return mean, covariance


def _imported() -> ModuleType:
    """filterpy's Kalman filter, from two files of it alone.

    The packages of filterpy import scipy.stats for their other filters, which costs a second of processor time. If the
    program has imported filterpy, the module is that of the program.
    """
    package = find_spec("filterpy")
    if "filterpy.kalman" in sys.modules or package is None or package.origin is None:
        return import_module("filterpy.kalman")
    folder, stats = Path(package.origin).parent, ModuleType("filterpy.stats")
    stats.logpdf = _logpdf  # type: ignore[attr-defined]
    common = _loaded("filterpy.common.helpers", folder / "common" / "helpers.py")
    # A program that has imported any module of filterpy has imported all of them, so neither of the two is there.
    sys.modules.update({"filterpy.common": common, "filterpy.stats": stats})
    try:
        return _loaded("filterpy.kalman.kalman_filter", folder / "kalman" / "kalman_filter.py")
    finally:
        del sys.modules["filterpy.common"], sys.modules["filterpy.stats"]


def _loaded(name: str, file: Path) -> ModuleType:
    """A module from its file; the packages that contain it are not imported."""
    module = ModuleType(name)
    SourceFileLoader(name, str(file)).exec_module(module)
    return module


def _logpdf(*values: Any, **options: Any) -> float:
    """`filterpy.stats.logpdf`, for the likelihood of a filter, which is computed only if it is asked for."""
    from filterpy.stats import logpdf

    return float(logpdf(*values, **options))


_filterpy = _imported()

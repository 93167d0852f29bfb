"""The motion of a centre: a Kalman filter of filterpy, with the matrices of constant velocity.

The state is (x, y, vx, vy), in pixels and pixels a frame; x and y are measured. The detector filters with it, and the
trainer smooths with it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from filterpy.kalman import KalmanFilter

__all__ = ["OBSERVED", "TRANSITION", "constant_velocity", "predicted", "updated"]

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
    if "filterpy.kalman" not in sys.modules and (package := find_spec("filterpy")) is not None and package.origin:
        folder = Path(package.origin).parent
        common = _loaded("filterpy.common.helpers", folder / "common" / "helpers.py")
        stats = ModuleType("filterpy.stats")
        stats.logpdf = _logpdf  # type: ignore[attr-defined]
        with _modules({"filterpy.common": common, "filterpy.stats": stats}):
            return _loaded("filterpy.kalman.kalman_filter", folder / "kalman" / "kalman_filter.py")
    return import_module("filterpy.kalman")


def _loaded(name: str, file: Path) -> ModuleType:
    """A module from its file; the packages that contain it are not imported."""
    spec = spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ImportError(f"{file} is not a module: install filterpy again")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@contextmanager
def _modules(modules: dict[str, ModuleType]) -> Iterator[None]:
    """Let these modules be found by an import inside the `with`."""
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def _logpdf(*values: Any, **options: Any) -> float:
    """`filterpy.stats.logpdf`, for the likelihood of a filter, which is computed only if it is asked for."""
    from filterpy.stats import logpdf

    return float(logpdf(*values, **options))


_filterpy = _imported()

"""filterpy's Kalman filter is used without the imports of filterpy's other modules, which take a second."""

from __future__ import annotations

import subprocess
import sys

FILTERED = """
import sys
import numpy as np
{first}
from catstream.numerics.kalman import constant_velocity

kalman = constant_velocity(np.array([1.0, 2, 3, 4]), np.eye(4), np.eye(4), np.eye(2))
kalman.predict()
kalman.update(np.array([4.5, 6.5]))
print(*kalman.x)
{then}
"""


def output(first="", then=""):
    """What a new process prints that uses the filter; an import before it, and a statement after it."""
    program = FILTERED.format(first=first, then=then)
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    return ended.stdout.splitlines()


def test_the_filter_needs_no_other_module_of_filterpy():
    then = "print(*(name for name in sys.modules if name.startswith(('filterpy', 'scipy', 'matplotlib'))))"
    assert output(then=then) == ["4.375 6.375 3.125 4.125", ""]


def test_a_program_that_uses_filterpy_gets_the_same_class_and_the_same_numbers():
    then = "print(type(kalman) is filterpy.kalman.KalmanFilter)"
    assert output("import filterpy.kalman", then) == ["4.375 6.375 3.125 4.125", "True"]


def test_a_program_may_import_filterpy_afterwards():
    then = "from filterpy.kalman import UnscentedKalmanFilter; print(round(kalman.log_likelihood, 4))"
    assert output(then=then)[1] == "-3.2867"

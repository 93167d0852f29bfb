"""Search for the highest rate at which a load test meets its limits."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["find_highest_rate"]

_LEAST, _MOST = 0.5, 1000.0  # frames per second
_PRECISION = 0.05  # maximum relative error of the result


def find_highest_rate(start: float, holds: Callable[[float], bool]) -> float | None:
    """Return the highest rate for which `holds` is true, to within 5 %; None if it is false even for the lowest rate.

    The rate is doubled or halved from `start` until the limit is between two rates, and then bisected. `holds` is
    called once for each rate, so random variation of its result affects the answer.

    >>> find_highest_rate(25.0, lambda rate: rate <= 42)
    40.6
    """
    low = high = None
    rate = min(max(start, _LEAST), _MOST)
    while low is None or high is None:
        if holds(rate):
            low = rate
            if rate == _MOST:
                return rate
            rate = min(2 * rate, _MOST)
        else:
            high = rate
            if rate == _LEAST:
                return None
            rate = max(rate / 2, _LEAST)
        rate = round(rate, 1)
    while high - low > _PRECISION * low:
        middle = round((low + high) / 2, 1)
        if middle in (low, high):
            break
        if holds(middle):
            low = middle
        else:
            high = middle
    return low

"""Looking for the highest rate that holds."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["find_highest_rate"]

_LEAST, _MOST = 0.5, 1000.0  # frames a second
_PRECISION = 0.05  # share of the rate by which it may be too low


def find_highest_rate(start: float, holds: Callable[[float], bool]) -> float | None:
    """The highest rate that holds, to a twentieth; None where not even half a frame a second does.

    From a start it is doubled or halved until it lies between two rates, then bisected. `holds` is
    called once a rate; where chance plays a part in what it says, so it does in the answer.

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

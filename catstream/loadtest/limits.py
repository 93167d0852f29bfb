"""Limits: what a run must hold, and what of it was violations."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass

from catstream.errors import SettingsError
from catstream.loadtest.latencies import PERCENTILES
from catstream.loadtest.run import Result

__all__ = ["KINDS", "Limit", "violations"]


@dataclass(frozen=True, slots=True)
class _Quantity:
    """What a limit may be on: how it is read off a result, and whether more of it is better."""

    about: str
    measure: Callable[[Result], float]
    minimum: bool = False


def _worst(name: str, kind: str) -> Callable[[Result], float]:
    return lambda result: max(getattr(stream, kind)[name] for stream in result.streams)


def _recovery(result: Result) -> float:
    never = float("inf")
    return max((recovery.track or never for recovery in result.recoveries), default=0.0)


#: All limits, by name. Of several streams the worst counts.
KINDS: dict[str, _Quantity] = {
    **{name: _Quantity("seconds from a frame to its track", _worst(name, "track")) for name in PERCENTILES},
    **{
        f"model-{name}": _Quantity("seconds from a frame to the model that has seen it", _worst(name, "model"))
        for name in PERCENTILES
    },
    "skipped": _Quantity(
        "share of frames that were not followed",
        lambda result: max(stream.skipped_share for stream in result.streams),
    ),
    "missed": _Quantity("share of tracks that quick subscribers missed", lambda result: result.missed_share),
    "recovery": _Quantity("seconds from a kill to the next track", _recovery),
    "success": _Quantity(
        "share of frames with an overlap above 0.5",
        lambda result: min(stream.success or 0.0 for stream in result.streams),
        minimum=True,
    ),
}


@dataclass(frozen=True, slots=True)
class Limit:
    """One limit: a name of `KINDS`, and the value to hold.

    >>> Limit.parse("p99=0.1")
    Limit(name='p99', value=0.1)
    """

    name: str
    value: float

    @classmethod
    def parse(cls, text: str) -> Limit:
        """Read `NAME=VALUE`.

        Raises
        ------
        SettingsError
            Where it is not that.
        """
        name, _, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if name not in KINDS or not 0 <= value < float("inf"):
            raise SettingsError(
                f"a limit is NAME=VALUE with one of {', '.join(KINDS)}, got {text!r}: for example p99=0.1"
            )
        return cls(name, value)

    def __str__(self) -> str:
        return f"{self.name}={self.value:g}"

    def is_met(self, result: Result) -> bool:
        kind = KINDS[self.name]
        return (operator.ge if kind.minimum else operator.le)(kind.measure(result), self.value)

    def describe(self, result: Result) -> str:
        """What it is, and what came of it."""
        kind = KINDS[self.name]
        sense = "least" if kind.minimum else "most"
        return f"{self.name} is {kind.measure(result):.4g}, to be at {sense} {self.value:g} ({kind.about})"


def violations(limits: list[Limit], result: Result) -> list[str]:
    """What was violations, in a line each: limits, and streams that failed."""
    return [*result.errors, *(limit.describe(result) for limit in limits if not limit.is_met(result))]

"""Limits on the measures of a load test, and their violations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from catstream.applications.loadtest.measures import PERCENTILES, percentiles
from catstream.applications.loadtest.run import Result
from catstream.errors import SettingsError


@dataclass(frozen=True, slots=True)
class _Quantity:
    """A quantity that can have a limit: its description, its value in a result, and whether the limit is a minimum."""

    about: str
    measure: Callable[[Result], float]
    minimum: bool = False


def _worst(name: str, kind: str) -> Callable[[Result], float]:
    return lambda result: max(percentiles(getattr(stream, kind))[name] for stream in result.streams)


#: All quantities that can have a limit, by name. If there are several streams, the worst one counts.
KINDS: dict[str, _Quantity] = {
    **{name: _Quantity("seconds from a frame to its track", _worst(name, "track")) for name in PERCENTILES},
    **{
        f"model-{name}": _Quantity("seconds from a frame to the model trained on it", _worst(name, "model"))
        for name in PERCENTILES
    },
    "skipped": _Quantity(
        "share of frames that were not tracked",
        lambda result: max(stream.skipped_share for stream in result.streams),
    ),
    "missed": _Quantity("share of frames whose tracks fast subscribers missed", lambda result: result.missed_share),
    "success": _Quantity(
        "share of frames with an overlap above 0.5",
        lambda result: min(stream.success or 0.0 for stream in result.streams),
        minimum=True,
    ),
}


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit on one of the quantities in `KINDS`.

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
            If the text has another format, or the name is unknown.
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
        value = kind.measure(result)
        return value >= self.value if kind.minimum else value <= self.value

    def describe(self, result: Result) -> str:
        """Describe the limit and the measured value."""
        kind = KINDS[self.name]
        sense = "least" if kind.minimum else "most"
        return f"{self.name} is {kind.measure(result):.4g}, limit at {sense} {self.value:g} ({kind.about})"


def violations(limits: list[Limit], result: Result) -> list[str]:
    """Return a line for each stream that failed and each limit that was not met."""
    return [*result.errors, *(limit.describe(result) for limit in limits if not limit.is_met(result))]

"""The plan of a load test: its parameters, and the limits on what it measures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from catstream.applications.loadtest import crowd
from catstream.applications.loadtest.latency import PERCENTILES, percentiles
from catstream.errors import SettingsError
from catstream.messages.names import check_count, counted
from catstream.settings import Settings
from catstream.video.rendered import SIZE

if TYPE_CHECKING:
    from catstream.applications.loadtest.load_test import Result


@dataclass(frozen=True, slots=True)
class Plan:
    """The parameters of one run.

    streams           number of pipelines, each of three processes
    objects           number of objects that each pipeline tracks
    subscribers       number of subscribers to the tracks of each stream
    slow_subscribers  number of those that are slow; half of these are frozen instead
    rate              frames per second of each stream, whether or not the pipeline keeps up
    duration          seconds
    size              (width, height) of a frame in pixels
    settings          settings of all pipelines
    """

    streams: int = 1
    objects: int = 1
    subscribers: int = 0
    slow_subscribers: int = 0
    rate: float = 25.0
    duration: float = 10.0
    size: tuple[int, int] = SIZE
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        if self.slow_subscribers > self.subscribers:
            raise SettingsError(
                f"{self.slow_subscribers} of {self.subscribers} subscribers cannot be slow: "
                "give more, or fewer slow ones"
            )
        if self.frames < 1:
            raise SettingsError(
                f"no frame is due in {self.duration:g} s at {self.rate:g} frames/s: give a higher rate or more seconds"
            )
        if self.objects > (most := len(crowd.NAMES)):
            raise SettingsError(
                f"the video of a load test shows at most {most} objects, not {self.objects}: give fewer"
            )
        check_count(self.objects, self.settings.run.objects_most)
        if self.settings.run.lockstep:
            raise SettingsError("the frames of a load test do not wait for models: leave out lockstep")
        if self.settings.run.endpoint:
            raise SettingsError("each stream of a load test has an endpoint of its own: leave out endpoint")

    def __str__(self) -> str:
        objects = f", {self.objects} objects" if self.objects > 1 else ""
        size = f"{self.size[0]}x{self.size[1]} pixels"
        return f"{counted(self.streams, 'stream')} of {size}{objects}, {self.rate:g} frames/s due in each"

    @property
    def frozen(self) -> int:
        """Number of the slow subscribers that are frozen."""
        return self.slow_subscribers // 2

    @property
    def frames(self) -> int:
        """Number of frames of each stream."""
        return round(self.rate * self.duration)


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
        "share of frames that were not tracked", lambda result: max(stream.skipped_share for stream in result.streams)
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
        """Read `NAME=VALUE`."""
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

"""The plan, the results and the limits of a load test."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.box import Box
from catstream.base.names import check_count
from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.errors import SettingsError
from catstream.measure.latency import PERCENTILES, REST, Measures, Reading, Receipts
from catstream.video import rendered

#: The figures that can have a limit, by name. With several streams, the limit applies to the worst one.
KINDS = {
    **dict.fromkeys(PERCENTILES, "from a frame to its track"),
    **{f"model-{name}": "from a frame to the model trained on it" for name in PERCENTILES},
    "skipped": "share of frames that were not tracked",
    **{f"subscriber-{name}": "from a frame to its receipt by fast subscribers" for name in PERCENTILES},
    "subscriber-missed": "share of frames that fast subscribers missed",
    "success": "share of frames with an IoU above 0.5",
}
#: The figures that are shares; the others are times.
SHARES = ("skipped", "subscriber-missed", "success")

#: The parameters that a search can maximise, by name, with the upper bound of the search.
SEARCHES = {"streams": 64, "rate": 1000, "subscribers": 1000}

#: Called about ten times a second with the current activity, its progress from 0 to 1, and current figures.
Report = Callable[[str, float, str], None]


@dataclass(frozen=True, slots=True)
class Plan:
    """The parameters of one run.

    streams           number of pipelines, each of three processes
    objects           number of objects that each pipeline tracks
    subscribers       number of subscribers to each of the channels of each stream
    slow_subscribers  number of slow subscribers among them
    channels          channels of the subscribers
    rate              frames per second of each stream, even if the pipeline cannot keep up
    duration          seconds
    size              (width, height) of a frame in pixels
    video             recording that the camera sends in a loop; empty for the rendered video
    boxes, models     objects of the recording: boxes in its first frame, and files of saved models, by name
    source            "mjpeg" (over HTTP) or "h264" (over RTSP)
    warm_up           whether the training of the first models is measured as well
    settings          settings of all pipelines
    """

    streams: int = 1
    objects: int = 1
    subscribers: int = 0
    slow_subscribers: int = 0
    channels: tuple[str, ...] = ("tracks",)
    rate: float = 25.0
    duration: float = 10.0
    size: tuple[int, int] = rendered.SIZE
    source: str = "mjpeg"
    video: str = ""
    boxes: dict[str, Box] = field(default_factory=dict)
    models: dict[str, Path] = field(default_factory=dict)
    warm_up: bool = False
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        if self.slow_subscribers > self.subscribers:
            raise SettingsError(
                f"more slow subscribers ({self.slow_subscribers}) than subscribers ({self.subscribers}): "
                "raise --subscribers, or lower --slow-subscribers"
            )
        if self.frames < 1:
            raise SettingsError(
                f"no frame is due in {self.duration:g} s at {self.rate:g} frames/s: raise --rate or --duration"
            )
        if self.source == "h264" and any(side % 2 for side in self.size):
            raise SettingsError(
                f"H.264 needs an even width and height, got {self.size[0]}x{self.size[1]}: pass another --size"
            )
        check_count(self.objects, self.settings.run.max_objects)
        if self.settings.run.lockstep:
            raise SettingsError(
                "a load test does not support lockstep, because its frames do not wait for models: omit run.lockstep"
            )

    def __str__(self) -> str:
        objects = f", {self.objects} objects" if self.objects > 1 else ""
        video = f"{Path(self.video).name + ', ' * bool(self.video)}{self.size[0]}x{self.size[1]} pixels ({self.source})"
        subscribers = f", {counted(self.subscribers, 'subscriber')} to each" if self.subscribers else ""
        return f"{counted(self.streams, 'stream')} of {video}{objects}, {self.rate:g} frames/s due in each{subscribers}"

    def number(self, name: str) -> str:
        """Format the value of one of the `SEARCHES` with its unit."""
        return f"{self.rate:g} frames/s" if name == "rate" else counted(getattr(self, name), name.removesuffix("s"))

    @property
    def fast_subscribers(self) -> int:
        return self.subscribers - self.slow_subscribers

    @property
    def frames(self) -> int:
        return round(self.rate * self.duration)


@dataclass(slots=True)
class Result:
    """The results of one run.

    plan         parameters of the run
    seconds      duration of the measured frames, shorter if the run was interrupted
    streams      measures of each stream
    readings     processor and memory use of each process, and processor use of other processes
    subscribers  measures of the fast subscribers to each channel of each stream
    camera_late  largest delay in seconds of a frame that the camera caused
    errors       errors of failed streams
    interrupted  whether the run was interrupted
    """

    plan: Plan
    seconds: float
    streams: list[Measures]
    readings: list[Reading]
    subscribers: list[Receipts]
    camera_late: float
    errors: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def worst(self) -> dict[str, float]:
        """The worst value of each of the `KINDS`; 0 for subscribers if there are no fast ones."""
        worst = dict.fromkeys(KINDS, 0.0) | {"success": 1.0}
        for figures in [stream.figures for stream in self.streams] + [each.figures for each in self.subscribers]:
            for name, value in figures.items():
                worst[name] = (min if name == "success" else max)(worst[name], value)
        return worst

    @property
    def track(self) -> Float64:
        """The latencies of the frames of all streams."""
        return np.concatenate([stream.track for stream in self.streams])

    @property
    def model(self) -> Float64:
        return np.concatenate([stream.model for stream in self.streams])

    def rate(self, skipped: float) -> float:
        """Return the tracked frames per second for a share of skipped frames."""
        return self.plan.rate * (1 - skipped)

    @property
    def cores(self) -> dict[str, float]:
        """Mean number of busy cores by the name of the process, and of `REST`."""
        names = dict.fromkeys(name for reading in self.readings for name in reading.cores)
        weights = [reading.seconds for reading in self.readings]
        return {name: fmean([each.cores.get(name, 0.0) for each in self.readings], weights) for name in names}

    @property
    def memory(self) -> dict[str, int]:
        """Proportional set size (PSS) of each process at the end, in bytes."""
        return self.readings[-1].memory

    def cost(self, number: int) -> tuple[float, int]:
        """Return the processor seconds per second and the memory in bytes of the processes of a stream."""
        of_stream = f" {number}"
        cores = sum(cores for name, cores in self.cores.items() if name.endswith(of_stream))
        return cores, sum(size for name, size in self.memory.items() if name.endswith(of_stream))

    @property
    def mean_cost(self) -> tuple[float, float]:
        cores, sizes = zip(*map(self.cost, range(len(self.streams))), strict=True)
        return fmean(cores), fmean(sizes)

    @property
    def other_load(self) -> float:
        """Mean number of cores that were busy with processes outside the load test."""
        return self.cores[REST]


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit on one of the `KINDS`: a minimum for the success, a maximum for all others.

    >>> Limit.parse("p99=0.1"), Limit.parse("skipped=1%")
    (Limit(name='p99', value=0.1), Limit(name='skipped', value=0.01))
    """

    name: str
    value: float

    @classmethod
    def parse(cls, text: str) -> Limit:
        """Parse `NAME=VALUE`; times are in seconds, or end with `ms`, and shares may end with `%`."""
        name, _, number = text.partition("=")
        unit, factor = ("%", 0.01) if name in SHARES else ("ms", 0.001)
        try:
            value = float(number.removesuffix(unit)) * (factor if number.endswith(unit) else 1)
        except ValueError:
            value = float("nan")
        if name not in KINDS or not 0 <= value < float("inf"):
            raise SettingsError(
                f"a limit is NAME=VALUE with one of {', '.join(KINDS)}, got {text!r}: for example p99=0.1"
            )
        return cls(name, value)

    @classmethod
    def defaults(cls, plan: Plan, find: str | None = None) -> list[Limit]:
        """Return the default limits: p99 of 0.1 s, no skipped frame (1 % with the warm-up).

        In a search for the number of subscribers, also their p99 of 0.1 s and no missed frame.
        """
        limits = [cls("p99", 0.1), cls("skipped", 0.01 if plan.warm_up else 0.0)]
        return limits + [cls("subscriber-p99", 0.1), cls("subscriber-missed", 0.0)] * (find == "subscribers")

    def is_met(self, result: Result) -> bool:
        value = result.worst[self.name]
        return value >= self.value if self.name == "success" else value <= self.value

    def describe(self, result: Result) -> str:
        """Describe the figure and its limit, with times in milliseconds."""
        value, limit = (
            f"{number:.4g}" if self.name in SHARES else f"{1000 * number:.4g} ms"
            for number in (result.worst[self.name], self.value)
        )
        sense = "least" if self.name == "success" else "most"
        return f"{self.name} is {value}, limit at {sense} {limit} ({KINDS[self.name]})"


def violations(limits: Iterable[Limit], result: Result) -> list[str]:
    """Return a line for each failed stream and each exceeded limit."""
    return [*result.errors, *(limit.describe(result) for limit in limits if not limit.is_met(result))]

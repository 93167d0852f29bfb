"""A load test: its plan, its limits, a single run, and the search for the highest number of streams."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from os import getpid
from statistics import fmean
from time import monotonic

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.names import check_count
from catstream.base.settings import Settings
from catstream.base.text import counted
from catstream.errors import ServiceError, SettingsError
from catstream.loadtest.camera import Camera, Schedule
from catstream.loadtest.latency import (
    PERCENTILES,
    REST,
    Measures,
    Observations,
    Usage,
    measure,
    observed,
    percentiles,
    proportional_memory,
)
from catstream.loadtest.load import Stream, Subscribers, Video, render
from catstream.loadtest.rtsp import encode
from catstream.video import rendered

MOST_STREAMS = 64  # of a load test
_START_TIMEOUT_SECONDS = 120.0  # for each phase of the start
_LEAD_SECONDS = 0.5  # from the end of the start to the first frame, and half a frame: a still is no nearer to it
_GRACE_SECONDS = 3.0  # to wait for the track of the last frame
_READING_SECONDS = 0.5  # between two readings of processor and memory use
_STILL = 13  # images of the still that are encoded as H.264: 24 frames, of which the first is a keyframe
_LOOP_SECONDS = 0.05


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
    source            what the camera sends: mjpeg, over HTTP, or h264, over RTSP
    settings          settings of all pipelines
    """

    streams: int = 1
    objects: int = 1
    subscribers: int = 0
    slow_subscribers: int = 0
    rate: float = 25.0
    duration: float = 10.0
    size: tuple[int, int] = rendered.SIZE
    source: str = "mjpeg"
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
        if self.settings.run.endpoint:
            raise SettingsError("each stream of a load test has its own endpoint: omit run.endpoint")

    def __str__(self) -> str:
        objects = f", {self.objects} objects" if self.objects > 1 else ""
        size = f"{self.size[0]}x{self.size[1]} pixels{', H.264' * (self.source == 'h264')}"
        return f"{counted(self.streams, 'stream')} of {size}{objects}, {self.rate:g} frames/s due in each"

    @property
    def frozen(self) -> int:
        """Number of the slow subscribers that are frozen."""
        return self.slow_subscribers // 2

    @property
    def frames(self) -> int:
        return round(self.rate * self.duration)


@dataclass(frozen=True, slots=True)
class _Quantity:
    """A quantity that can have a limit: its description, its value in a result, and whether the limit is a minimum.

    Limits of a time are given in seconds; people read milliseconds, as in the tables.
    """

    about: str
    measure: Callable[[Result], float]
    minimum: bool = False
    is_time: bool = False

    def in_words(self, value: float) -> str:
        return f"{1000 * value:.4g} ms" if self.is_time else f"{value:.4g}"


def _worst(name: str, kind: str) -> Callable[[Result], float]:
    return lambda result: max(percentiles(getattr(stream, kind))[name] for stream in result.streams)


#: All quantities that can have a limit, by name. If there are several streams, the worst one counts.
KINDS: dict[str, _Quantity] = {
    **{name: _Quantity("from a frame to its track", _worst(name, "track"), is_time=True) for name in PERCENTILES},
    **{
        f"model-{name}": _Quantity("from a frame to the model trained on it", _worst(name, "model"), is_time=True)
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
        kind = KINDS[self.name]
        sense = "least" if kind.minimum else "most"
        value, limit = kind.in_words(kind.measure(result)), kind.in_words(self.value)
        return f"{self.name} is {value}, limit at {sense} {limit} ({kind.about})"


def violations(limits: list[Limit], result: Result) -> list[str]:
    """Return a line for each stream that failed and each limit that was not met."""
    return [*result.errors, *(limit.describe(result) for limit in limits if not limit.is_met(result))]


#: Is called about ten times a second with the current activity, the share of it that is done, and current figures.
Report = Callable[[str, float, str], None]


@dataclass(slots=True)
class Result:
    """The results of one run.

    plan         parameters of the run
    seconds      duration of the measured frames: less than planned if the run was interrupted
    streams      measures of each stream
    usage        readings of the busy cores of each process, and of the processes outside the load test
    received     number of frames whose tracks each fast subscriber received; `missed` is the number that it missed
    frozen       seconds for which the frozen subscribers were stopped
    camera_late  largest delay in seconds of a frame that the camera itself caused
    memory       bytes of each process, in which a shared page counts in proportion (PSS)
    errors       errors of failed streams
    interrupted  whether the run was interrupted
    """

    plan: Plan
    seconds: float
    streams: list[Measures]
    usage: dict[str, list[float]]
    received: list[int]
    missed: list[int]
    frozen: float
    camera_late: float
    memory: dict[str, int] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def followed(self) -> float:
        """Frames per second that were tracked in the worst stream."""
        return min(stream.rate(self.plan.rate) for stream in self.streams)

    @property
    def track(self) -> Float64:
        return np.concatenate([stream.track for stream in self.streams])

    @property
    def model(self) -> Float64:
        return np.concatenate([stream.model for stream in self.streams])

    def cores(self, number: int) -> float:
        """Return the processor seconds per second of the processes of a stream."""
        return sum(fmean(readings) for name, readings in self.usage.items() if name.endswith(f" {number}"))

    def stream_memory(self, number: int) -> int:
        """Return the bytes of the processes of a stream."""
        return sum(size for name, size in self.memory.items() if name.endswith(f" {number}"))

    @property
    def cost(self) -> tuple[float, float]:
        """Mean of the streams: processor seconds per second, and bytes of memory."""
        count = len(self.streams)
        return sum(map(self.cores, range(count))) / count, sum(map(self.stream_memory, range(count))) / count

    @property
    def other_load(self) -> float:
        """Mean number of cores that were busy with processes outside the load test."""
        return fmean(self.usage[REST]) if REST in self.usage else 0.0

    @property
    def missed_share(self) -> float:
        """Share of the frames whose tracks fast subscribers missed."""
        return sum(self.missed) / max(1, sum(self.missed) + sum(self.received))


def run(plan: Plan, video: Video, camera: Camera, report: Report) -> Result:
    """Run pipelines on the streams of a running camera, and measure; after Ctrl-C, return the measurements so far."""
    camera.show_still()
    streams = [Stream(number, url, video.boxes, plan.settings) for number, url in enumerate(camera.urls)]
    usage, interrupted, next_reading = Usage(), False, 0.0
    with ExitStack() as stack:
        observations, groups = _started(plan, streams, next(iter(video.boxes)), stack, report)

        def processes() -> dict[str, list[int]]:
            return _pids(streams, groups) | {"camera": [camera.pid], "load test": [getpid()]}

        schedules = camera.play(Schedule(monotonic() + _LEAD_SECONDS + 0.5 / plan.rate, plan.rate, plan.frames))
        try:
            for now in _until_the_last_track(plan, streams, observations, schedules):
                if now >= next_reading:
                    next_reading = now + _READING_SECONDS
                    usage.read(processes())
                report(*_progress(plan, observations, now - schedules[0].start))
        except KeyboardInterrupt:
            interrupted = True
        end, late = monotonic(), camera.late
        memory = {name: proportional_memory(pids) for name, pids in processes().items()}
        frozen = max((group.frozen_seconds for group in groups), default=0.0)
        report("ending", 1.0, "")
        _stop(streams)
        for group in groups:
            group.wait()
    due = [min(plan.frames, schedule.following(end)) if interrupted else plan.frames for schedule in schedules]
    if not all(number > 0 for number in due):
        raise KeyboardInterrupt
    return Result(
        plan=plan,
        seconds=min(due) / plan.rate,
        streams=[
            measure(observation, schedule, number, video.truth, end, stream.totals)
            for observation, schedule, number, stream in zip(observations, schedules, due, streams, strict=True)
        ],
        usage=usage.readings,
        received=[count for group in groups for count in group.received()],
        missed=[count for group in groups for count in group.missed()],
        frozen=frozen,
        camera_late=late,
        memory=memory,
        errors=[f"stream {number}: {stream.error}" for number, stream in enumerate(streams) if stream.error],
        interrupted=interrupted,
    )


def _started(
    plan: Plan, streams: list[Stream], name: str, stack: ExitStack, report: Report
) -> tuple[list[Observations], list[Subscribers]]:
    """Start the pipelines, wait for their first models, then connect the subscribers; the stack ends all of them."""

    def wait_until(condition: Callable[[], bool], activity: str) -> None:
        deadline = monotonic() + _START_TIMEOUT_SECONDS
        while not condition():
            for stream in streams:
                if stream.error is not None:
                    raise stream.error
            if monotonic() > deadline:
                raise ServiceError(
                    f"{activity} took more than {_START_TIMEOUT_SECONDS:.0f} s: the machine is too slow or too busy; "
                    "lower --streams, --subscribers or --rate"
                )
            report(activity, 0.0, "")
            time.sleep(_LOOP_SECONDS)

    stack.callback(_stop, streams)
    for stream in streams:
        stream.start()
    wait_until(lambda: all(stream.ready.is_set() for stream in streams), "starting processes")
    for stream in streams:
        if stream.error is not None:  # it has no endpoint to observe
            raise stream.error
    addresses = [stream.address for stream in streams if stream.address is not None]
    observations = stack.enter_context(observed(addresses, name))
    wait_until(lambda: all(stream.warmed_up for stream in observations), "learning the first models")
    counts = {"readers": plan.subscribers, "slow": plan.slow_subscribers - plan.frozen, "frozen": plan.frozen}
    groups = [stack.enter_context(Subscribers(address, **counts)) for address in addresses]
    wait_until(lambda: all(group.connected for group in groups), "attaching subscribers")
    for group in groups:
        group.freeze()
    return observations, groups


def _stop(streams: list[Stream]) -> None:
    """Stop all pipelines, and wait until they have ended, which they do concurrently."""
    for stream in streams:
        stream.stop()
    for stream in streams:
        stream.join()


def _until_the_last_track(
    plan: Plan, streams: list[Stream], observations: list[Observations], schedules: list[Schedule]
) -> Iterator[float]:
    """Yield the time twenty times a second.

    It ends if the last frame of each stream was tracked, if the grace time for it is over, or if all streams failed.
    """

    def is_tracked(stream: Observations, schedule: Schedule) -> bool:
        newest = stream.tracks[-1][1].pts
        return newest is not None and schedule.number(newest) >= plan.frames - 1

    last = schedules[-1].due(plan.frames - 1)
    while (now := monotonic()) < last + _GRACE_SECONDS and any(stream.is_alive() for stream in streams):
        if now > last and all(map(is_tracked, observations, schedules)):
            break
        yield now
        time.sleep(_LOOP_SECONDS)


def _progress(plan: Plan, observations: list[Observations], passed: float) -> tuple[str, float, str]:
    latest = max(stream.tracks[-1][0] - (stream.tracks[-1][1].pts or 0.0) for stream in observations)
    received = sum(len(stream.tracks) for stream in observations)
    figures = f"{received} tracks, the last {1000 * latest:.0f} ms after its frame"
    return f"{plan.frames * len(observations)} frames", min(max(passed / plan.duration, 0.0), 1.0), figures


def _pids(streams: list[Stream], groups: list[Subscribers]) -> dict[str, list[int]]:
    pids = {f"{name} {number}": [pid] for number, stream in enumerate(streams) for name, pid in stream.pids.items()}
    readers = [pid for group in groups for pid in group.pids]
    return pids | ({"subscribers": readers} if readers else {})


@dataclass(slots=True)
class LoadTest:
    """The runs of a load test.

    limits       the limits of each run
    find         whether the highest number of streams is searched for
    results      all runs, in order; empty if it was interrupted before the first measurement
    highest      the highest number of streams that meets the limits; None without a search, or if there is none
    refused      reasons why so many streams did not start, by their number
    interrupted  whether it was interrupted
    """

    limits: list[Limit]
    find: bool = False
    results: list[Result] = field(default_factory=list)
    highest: int | None = None
    refused: dict[int, str] = field(default_factory=dict)
    interrupted: bool = False

    @property
    def result(self) -> Result:
        """The decisive run: the one with the most streams that meets the limits, or the last one if none does."""
        passed = [result for result in self.results if not violations(self.limits, result)]
        return max(passed, key=lambda result: result.plan.streams, default=self.results[-1])

    @property
    def violations(self) -> list[str]:
        """The reasons why the load test has failed, one line each."""
        if not self.find:
            return [line for result in self.results for line in violations(self.limits, result)]
        if self.highest is None and not self.interrupted:
            lowest = self.results[-1].plan.streams
            return [f"no number of streams meets {', '.join(map(str, self.limits))}: the lowest tried was {lowest}"]
        return []


def run_load_test(
    plan: Plan,
    limits: list[Limit],
    *,
    find: bool = False,
    report: Report = lambda *_: None,
    done: Callable[[Result], None] = lambda _: None,
) -> LoadTest:
    """Run a load test. After Ctrl-C, the measurements so far are returned.

    find : search for the highest number of streams that meets the limits, beginning with that of the plan
    report, done : functions that are called with the progress, and after each run
    """
    load_test = LoadTest(limits, find)
    images = min(plan.frames, rendered.FRAMES)

    def report_frames(activity: str, count: int, total: int) -> None:
        report(activity, count / total, f"{count} of {total} frames")

    def holds(streams: int) -> bool:
        try:
            with Camera(files, plan.size, streams, plan.source, still) as camera:
                result = run(replace(plan, streams=streams), video, camera, report)
        except ServiceError as error:
            if not find or not load_test.results:
                raise
            load_test.refused[streams] = str(error)
            return False
        load_test.results.append(result)
        done(result)
        if result.interrupted:
            raise KeyboardInterrupt
        return not violations(limits, result)

    try:
        video = render(plan.objects, images, plan.size, lambda count: report_frames("rendering", count, images))
        files, still = video.files, video.files[:1]
        if plan.source == "h264":
            still = encode(still * _STILL, plan.size, lambda _: None)
            files = encode(files, plan.size, lambda count: report_frames("encoding", count, 2 * images))
        if find:
            load_test.highest = find_highest(plan.streams, holds, MOST_STREAMS)
        else:
            holds(plan.streams)
    except KeyboardInterrupt:
        load_test.interrupted = True
    return load_test


def find_highest(start: int, holds: Callable[[int], bool], most: int) -> int | None:
    """Return the highest number from 1 to `most` for which `holds` is true; None if it is false even for 1.

    The number is doubled or halved from `start` until the limit is between two numbers, and then bisected. `holds` is
    called once for each number, so random variation of its result affects the answer.

    >>> find_highest(1, lambda streams: streams <= 42, most=64)
    42
    """
    low, high, number = 0, most + 1, min(start, most)
    doubling = True
    while high - low > 1:
        if holds(number):
            low = number
        else:
            high, doubling = number, False
        number = min(2 * low, most) if doubling else (low + high) // 2
    return low or None

"""A load test: a single run, and the search for the highest number of streams."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from os import getpid
from time import monotonic

from catstream.errors import ServiceError, errors_in
from catstream.measure.camera import Camera, Schedule
from catstream.measure.latency import Observations, Usage, measure, observed
from catstream.measure.load import Stream
from catstream.measure.load_result import Limit, Plan, Report, Result, violations
from catstream.measure.load_video import Video, prepare
from catstream.measure.subscribers import Subscribers

MOST_STREAMS = 64  # of a load test
_START_TIMEOUT_SECONDS = 120.0  # for each phase of the start
_LEAD_SECONDS = 0.5  # from the end of the start to the first frame, and half a frame: a still is no nearer to it
_GRACE_SECONDS = 3.0  # to wait for the track of the last frame
_READING_SECONDS = 1.0  # between two readings of processor and memory use
_LOOP_SECONDS = 0.05


def run(plan: Plan, video: Video, report: Report) -> Result:
    """Run a camera and pipelines on its streams, and measure; after Ctrl-C, return the measurements so far."""
    usage, interrupted = Usage(), False
    with ExitStack() as stack:
        camera = stack.enter_context(Camera(plan.source, plan.size, video.units, video.still, plan.streams))
        streams = [Stream(number, url, video, plan.settings) for number, url in enumerate(camera.urls)]
        observations, groups = _started(plan, streams, video, stack, report)

        def processes() -> dict[str, list[int]]:
            pids = {f"{name} {stream.number}": [pid] for stream in streams for name, pid in stream.pids.items()}
            if readers := [pid for group in groups for pid in group.pids]:
                pids["subscribers"] = readers
            return pids | {"camera": [camera.pid], "load test": [getpid()]}

        for group in groups:
            group.begin(observations)
        schedules = camera.play(Schedule(monotonic() + _LEAD_SECONDS + 0.5 / plan.rate, plan.rate))
        usage.read(processes())
        next_reading = schedules[0].start + _READING_SECONDS
        try:
            for now in _until_the_last_track(plan, streams, observations, schedules):
                if now >= next_reading:
                    next_reading += _READING_SECONDS
                    usage.read(processes())
                passed = (now - schedules[0].start) / plan.duration
                tracks = f"{sum(len(stream.tracks) for stream in observations)} tracks"
                report(f"{plan.frames * plan.streams} frames", min(max(passed, 0.0), 1.0), tracks)
        except KeyboardInterrupt:
            interrupted = True
        end, late = monotonic(), camera.late
        usage.read(processes(), is_last=True)
        report("ending", 1.0, "")
        _stop(streams)
        for group in groups:
            group.wait()
    due = [min(plan.frames, schedule.following(end)) if interrupted else plan.frames for schedule in schedules]
    if min(due) <= 0:
        raise KeyboardInterrupt
    return Result(
        plan=plan,
        seconds=min(due) / plan.rate,
        streams=[
            measure(observation, schedule, number, video.truth, end, stream.totals, len(video.units))
            for observation, schedule, number, stream in zip(observations, schedules, due, streams, strict=True)
        ],
        readings=usage.readings,
        subscribers=[group.receipts(observations, schedules, due, end) for group in groups],
        camera_late=late,
        errors=[f"stream {stream.number}: {stream.error}" for stream in streams if stream.error],
        interrupted=interrupted,
    )


def _started(
    plan: Plan, streams: list[Stream], video: Video, stack: ExitStack, report: Report
) -> tuple[list[Observations], list[Subscribers]]:
    """Start the pipelines, wait for their first models, then connect the subscribers; the stack ends all of them."""

    def wait_until(condition: Callable[[], bool], activity: str) -> None:
        deadline = monotonic() + _START_TIMEOUT_SECONDS
        while not condition() and not any(stream.error for stream in streams):
            if monotonic() > deadline:
                raise ServiceError(
                    f"{activity} took more than {_START_TIMEOUT_SECONDS:.0f} s: the machine is too slow or too busy; "
                    "lower --streams, --subscribers or --rate"
                )
            report(activity, 0.0, "")
            time.sleep(_LOOP_SECONDS)
        for stream in streams:
            if stream.error is not None:
                with errors_in(f"stream {stream.number}", ServiceError):
                    raise stream.error

    stack.callback(_stop, streams)
    for stream in streams:
        stream.start()
    wait_until(lambda: all(stream.ready.is_set() for stream in streams), "starting processes")
    addresses = [stream.address for stream in streams if stream.address is not None]
    observations = stack.enter_context(observed(addresses, next(iter(video.boxes | video.models))))
    if plan.warm_up or not video.boxes:  # the object of a saved model need not be in the first frame
        wait_until(lambda: all(stream.tracks for stream in observations), "waiting for the first tracks")
    else:
        wait_until(lambda: all(stream.warmed_up for stream in observations), "learning the first models")
    groups = [
        Subscribers(plan, number, channel, address)
        for number, address in enumerate(addresses if plan.subscribers else ())
        for channel in plan.channels
    ]
    for group in groups:
        stack.enter_context(group)
    wait_until(lambda: all(group.connected for group in groups), "attaching subscribers")
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
        return schedule.number(stream.tracks[-1][1].pts or 0.0) >= plan.frames - 1

    last = schedules[-1].due(plan.frames - 1)
    while (now := monotonic()) < last + _GRACE_SECONDS and any(stream.is_alive() for stream in streams):
        if now > last and all(map(is_tracked, observations, schedules)):
            break
        yield now
        time.sleep(_LOOP_SECONDS)


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
        passed = [result for result in self.results if not (result.interrupted or violations(self.limits, result))]
        return max(passed, key=lambda result: result.plan.streams, default=self.results[-1])

    @property
    def sustained(self) -> bool | None:
        """True if no stream of the decisive run failed and it meets all limits; None if it was interrupted."""
        return None if self.interrupted else not violations(self.limits, self.result)


def run_load_test(
    plan: Plan,
    limits: list[Limit],
    *,
    find: bool = False,
    report: Report = lambda *_: None,
    done: Callable[[Result], None] = lambda _: None,
) -> LoadTest:
    """Run a load test. After Ctrl-C, the measurements so far are returned.

    find : search for the highest number of streams that meets the limits, beginning with the number in the plan
    report, done : functions that are called with the progress, and after each run
    """
    load_test = LoadTest(limits, find)

    def holds(streams: int) -> bool:
        try:
            result = run(replace(plan, streams=streams), video, report)
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
        video = prepare(plan, plan.frames, report)
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

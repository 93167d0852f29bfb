"""A load test: a single run, and the search for the highest number of streams, frames per second or subscribers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from os import getpid
from time import monotonic
from typing import Any

from catstream.errors import ServiceError, SettingsError, errors_in
from catstream.measure.camera import Camera, Schedule
from catstream.measure.latency import Observations, Usage, measure, observed
from catstream.measure.load import STOP_SECONDS, Stream
from catstream.measure.load_result import SEARCHES, Limit, Plan, Report, Result, violations
from catstream.measure.load_video import Video, prepare
from catstream.measure.subscribers import Subscribers

_START_TIMEOUT_SECONDS = 120.0  # for each phase of the start
_LEAD_SECONDS = 0.5  # delay of the first frame; half a frame is added, so no still image has its number
_GRACE_SECONDS = 3.0  # timeout for the track of the last frame
_READING_SECONDS = 1.0  # interval between two readings of processor and memory use
_LOOP_SECONDS = 0.05
_PRECISION = 0.05  # maximum relative error of the result of a search
_SEARCH_FRAMES = 1200  # frames of the video in a search for the rate: the whole rendered video
_FIRST_SUBSCRIBERS = 50  # default start of a search for the number of subscribers


def run(plan: Plan, video: Video, report: Report) -> Result:
    """Run a camera and pipelines on its streams, and measure; after Ctrl-C, return the measurements so far."""
    usage, interrupted = Usage(), False
    with ExitStack() as stack:
        # Step 1: start the camera, the pipelines and the subscribers.
        camera = stack.enter_context(Camera(plan.source, plan.size, video.units, video.still, plan.streams))
        streams = [Stream(number, url, video, plan.settings) for number, url in enumerate(camera.urls)]
        observations, groups = _started(plan, streams, video, stack, report)

        def processes() -> dict[str, list[int]]:
            pids = {f"{name} {stream.number}": [pid] for stream in streams for name, pid in stream.pids.items()}
            if readers := [pid for group in groups for pid in group.pids]:
                pids["subscribers"] = readers
            return pids | {"camera": [camera.pid], "load test": [getpid()]}

        # Step 2: begin the schedule, and read the processor and memory use until the last track.
        schedules = camera.play(Schedule(monotonic() + _LEAD_SECONDS + 0.5 / plan.rate, plan.rate))
        usage.read(processes())
        next_reading = schedules[0].start + _READING_SECONDS
        try:
            for now in _until_the_last_track(plan, streams, observations, schedules):
                if now >= next_reading:
                    next_reading = now + _READING_SECONDS
                    usage.read(processes())
                passed = (now - schedules[0].start) / plan.duration
                tracks = f"{sum(len(stream.tracks) for stream in observations)} tracks"
                report(f"{plan.frames * plan.streams} frames", min(max(passed, 0.0), 1.0), tracks)
        except KeyboardInterrupt:
            interrupted = True
        # Step 3: stop the pipelines, and compute the measures.
        end, late = monotonic(), camera.late
        usage.read(processes(), is_last=True)
        report("ending", 1.0, "")
        _stop(streams)
        due = [min(plan.frames, schedule.following(end)) if interrupted else plan.frames for schedule in schedules]
        if min(due) <= 0:
            raise KeyboardInterrupt
        frames = [*zip(observations, schedules, due, strict=True)]
        fast = groups if plan.fast_subscribers else []
        subscribers = [group.receipts(*frames[group.stream], end) for group in fast]
    return Result(
        plan=plan,
        seconds=min(due) / plan.rate,
        streams=[
            measure(*frames[stream.number], video.truth, end, stream.totals, len(video.units)) for stream in streams
        ],
        readings=usage.readings,
        subscribers=subscribers,
        camera_late=late,
        errors=[f"stream {stream.number}: {stream.error}" for stream in streams if stream.error],
        interrupted=interrupted,
    )


def _started(
    plan: Plan, streams: list[Stream], video: Video, stack: ExitStack, report: Report
) -> tuple[list[Observations], list[Subscribers]]:
    """Start one pipeline after the other, wait for the first models of all, and start the subscribers."""
    started: list[Stream] = []
    observations: list[Observations] = []

    def wait_until(condition: Callable[[], bool], activity: str) -> None:
        deadline = monotonic() + _START_TIMEOUT_SECONDS
        while not condition() and not any(stream.error for stream in started):
            if monotonic() > deadline:
                raise ServiceError(
                    f"{activity} took more than {_START_TIMEOUT_SECONDS:.0f} s: the machine is too slow or too busy; "
                    "lower --streams, --subscribers or --rate"
                )
            report(activity, 0.0, "")
            time.sleep(_LOOP_SECONDS)
        for stream in started:
            if stream.error is not None:
                with errors_in(f"stream {stream.number}", ServiceError):
                    raise stream.error

    stack.callback(_stop, started)
    for stream in streams:
        activity = f"starting stream {stream.number + 1} of {len(streams)}"
        stream.start()
        started.append(stream)
        wait_until(stream.ready.is_set, activity)
        observations.append(stack.enter_context(observed(stream.address, next(iter(video.boxes | video.models)))))
        wait_until(partial(bool, observations[-1].tracks), activity)
    # The object of a saved model need not be in the still image, from which the first models would be trained.
    if video.boxes and not plan.warm_up:
        wait_until(lambda: all(stream.warmed_up for stream in observations), "learning the first models")
    groups = [
        stack.enter_context(Subscribers(plan, stream.number, channel, stream.address))
        for stream in streams
        for channel in plan.channels
    ]
    wait_until(lambda: all(group.connected for group in groups), "attaching subscribers")
    return observations, groups


def _stop(streams: list[Stream]) -> None:
    """Stop all pipelines concurrently, and wait until they have ended."""
    for stream in streams:
        stream.stop()
    for stream in streams:
        stream.join(STOP_SECONDS)


def _until_the_last_track(
    plan: Plan, streams: list[Stream], observations: list[Observations], schedules: list[Schedule]
) -> Iterator[float]:
    """Yield the time twenty times a second until the last frame of each stream was tracked.

    Ends after the grace time, or if all streams have failed.
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
    find         parameter to maximise, one of `SEARCHES`; None for a single run
    results      all runs, in order; empty if the load test was interrupted before the first measurement
    refused      reasons why streams did not start, by the tried number
    interrupted  whether the load test was interrupted
    """

    limits: list[Limit]
    find: str | None = None
    results: list[Result] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)
    interrupted: bool = False

    def number(self, result: Result) -> int:
        """The value of the searched parameter in a run."""
        return int(getattr(result.plan, self.find or "streams"))

    @property
    def result(self) -> Result:
        """The decisive run: the last one with the highest number below all failed runs, or the last run."""
        runs = [result for result in self.results if not result.interrupted]
        failed = [self.number(result) for result in runs if violations(self.limits, result)]
        passed = [result for result in reversed(runs) if self.number(result) < min([*failed, *self.refused, inf])]
        return max(passed, key=self.number, default=self.results[-1])

    @property
    def highest(self) -> int | None:
        """The highest number that meets the limits, at least if the search was interrupted; None if there is none."""
        is_met = not (self.result.interrupted or violations(self.limits, self.result))
        return self.number(self.result) if self.find and is_met else None

    @property
    def sustained(self) -> bool | None:
        """True if the decisive run meets all limits without a failed stream; None if it was interrupted."""
        return None if self.interrupted else not violations(self.limits, self.result)


def run_load_test(
    plan: Plan,
    limits: list[Limit],
    *,
    find: str | None = None,
    report: Report = lambda *_: None,
    done: Callable[[Result], None] = lambda _: None,
) -> LoadTest:
    """Run a load test. After Ctrl-C, the measurements so far are returned.

    find : parameter whose highest value within the limits is searched, beginning with the value in the plan
    report, done : functions that are called with the progress, and after each run
    """
    has_fast = plan.fast_subscribers or find == "subscribers"
    if not has_fast and any(limit.name.startswith("subscriber-") for limit in limits):
        raise SettingsError("a limit of subscribers requires fast ones: raise --subscribers, or omit the limit")
    load_test = LoadTest(limits, find)

    def holds(number: int) -> bool:
        changes: dict[str, Any] = {find: number} if find else {}
        if find == "subscribers":
            changes["slow_subscribers"] = min(number, plan.slow_subscribers)
        try:
            result = run(replace(plan, **changes), video, report)
        except ServiceError as error:
            if not load_test.results:
                raise
            load_test.refused[number] = str(error)
            return False
        load_test.results.append(result)
        done(result)
        if result.interrupted:
            raise KeyboardInterrupt
        return not violations(limits, result)

    try:
        video = prepare(plan, max(plan.frames, _SEARCH_FRAMES) if find == "rate" else plan.frames, report)
        if find:
            start = round(getattr(plan, find)) or _FIRST_SUBSCRIBERS
            find_highest(max(1, start), holds, SEARCHES[find])
        else:
            holds(plan.streams)
    except KeyboardInterrupt:
        load_test.interrupted = True
    return load_test


def find_highest(start: int, holds: Callable[[int], bool], most: int) -> int | None:
    """Return the highest number from 1 to `most` for which `holds` is true twice; None if it is false for 1.

    The number is doubled or halved from `start` until the limit is between two numbers, and then bisected to within
    5 %. `holds` is called again for the result; if it is false, the search continues below.

    >>> find_highest(1, lambda streams: streams <= 17, most=64)
    17
    """
    runs, high = {0: 2}, most + 1  # successful runs by number, all below the lowest number that has failed
    number, is_doubled = min(start, most), True
    while True:
        if holds(number):
            runs[number] = runs.get(number, 0) + 1
        else:
            high, is_doubled = number, False
            runs = {each: count for each, count in runs.items() if each < high}
        low = max(runs)
        if high - low > max(1, low * _PRECISION):
            number = min(2 * low, most) if is_doubled else (low + high) // 2
        elif runs[low] < 2:
            number = low
        else:
            return low or None

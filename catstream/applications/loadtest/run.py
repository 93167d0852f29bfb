"""One run of a load test: starts the processes, runs the schedule, and collects the measurements."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from os import getpid
from time import monotonic

import numpy as np

from catstream.applications.loadtest.broadcast import Schedule
from catstream.applications.loadtest.camera import Camera
from catstream.applications.loadtest.measures import Measures, measure
from catstream.applications.loadtest.observer import Observations, observed
from catstream.applications.loadtest.plan import Plan
from catstream.applications.loadtest.stream import Stream
from catstream.applications.loadtest.subscribers import Subscribers
from catstream.applications.loadtest.usage import REST, Usage, UsageReading, summary
from catstream.errors import ServiceError
from catstream.numerics.arrays import Float64

_START_TIMEOUT_SECONDS = 120.0  # for each phase of the start
_LEAD_SECONDS = 0.5  # from the end of the start to the first frame, and half a frame: a still is no nearer to it
_GRACE_SECONDS = 3.0  # to wait for the track of the last frame
_READING_SECONDS = 0.5  # between two readings of processor and memory use
_LOOP_SECONDS = 0.05


#: Is called about ten times a second with the current activity, the share of it that is done, and current figures.
Report = Callable[[str, float, str], None]


@dataclass(slots=True)
class Result:
    """The results of one run.

    plan         parameters of the run
    seconds      duration of the measured frames: less than planned if the run was interrupted
    streams      measures of each stream
    usage        readings of each process, and of the load by processes outside the load test
    received     number of frames whose tracks each fast subscriber received; `missed` is the number that it missed
    frozen       seconds for which the frozen subscribers were stopped
    camera_late  largest delay in seconds of a frame that the camera itself caused
    errors       errors of failed streams
    interrupted  whether the run was interrupted
    """

    plan: Plan
    seconds: float
    streams: list[Measures]
    usage: dict[str, list[UsageReading]]
    received: list[int]
    missed: list[int]
    frozen: float
    camera_late: float
    errors: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def followed(self) -> float:
        """Frames per second that were tracked in the worst stream."""
        return min(stream.rate(self.plan.rate) for stream in self.streams)

    @property
    def track(self) -> Float64:
        """Track latencies of all streams."""
        return np.concatenate([stream.track for stream in self.streams])

    @property
    def model(self) -> Float64:
        """Model latencies of all streams."""
        return np.concatenate([stream.model for stream in self.streams])

    @property
    def other_load(self) -> float:
        """Mean number of cores that were busy with processes outside the load test."""
        return summary(self.usage[REST])["cores"] if REST in self.usage else 0.0

    @property
    def missed_share(self) -> float:
        """Share of the frames whose tracks fast subscribers missed."""
        return sum(self.missed) / max(1, sum(self.missed) + sum(self.received))


def run(plan: Plan, camera: Camera, report: Report = lambda *_: None) -> Result:
    """Run pipelines on the streams of a camera, and measure.

    After Ctrl-C, the measurements so far are returned.

    Parameters
    ----------
    camera : a running camera with the number of streams of the plan
    report : function that is called with the progress

    Raises
    ------
    CatstreamError
        If a pipeline cannot start.
    """
    camera.show_still()
    streams = [Stream(number, url, camera.video.boxes, plan.settings) for number, url in enumerate(camera.urls)]
    usage, interrupted, next_reading = Usage(), False, 0.0
    with ExitStack() as stack:
        seen, groups = _started(plan, streams, next(iter(camera.video.boxes)), stack, report)
        schedules = camera.play(Schedule(monotonic() + _LEAD_SECONDS + 0.5 / plan.rate, plan.rate, plan.frames))
        try:
            for now in _until_the_last_track(plan, streams, seen, schedules):
                if now >= next_reading:
                    next_reading = now + _READING_SECONDS
                    usage.read(now, _pids(streams, groups) | {"camera": [camera.pid], "load test": [getpid()]})
                report(*_progress(plan, seen, now - schedules[0].start))
        except KeyboardInterrupt:
            interrupted = True
        end, late = monotonic(), camera.late
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
            measure(each, schedule, number, camera.video.truth, end, stream.totals)
            for each, schedule, number, stream in zip(seen, schedules, due, streams, strict=True)
        ],
        usage=usage.readings,
        received=[count for group in groups for count in group.received()],
        missed=[count for group in groups for count in group.missed()],
        frozen=frozen,
        camera_late=late,
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
                    f"{activity} took more than {_START_TIMEOUT_SECONDS:.0f} s: this machine is too slow or too busy, "
                    "give fewer streams, subscribers or frames a second"
                )
            report(activity, 0.0, "")
            time.sleep(_LOOP_SECONDS)

    stack.callback(_stop, streams)
    for stream in streams:
        stream.start()
    wait_until(lambda: all(stream.ready.is_set() for stream in streams), "starting processes")
    keys = plan.settings.run.keys
    seen = stack.enter_context(observed([stream.endpoint for stream in streams], name, keys))
    wait_until(lambda: all(each.warmed_up for each in seen), "learning the first models")
    counts = {"readers": plan.subscribers, "slow": plan.slow_subscribers - plan.frozen, "frozen": plan.frozen}
    groups = [stack.enter_context(Subscribers(stream.endpoint, keys=keys, **counts)) for stream in streams]
    wait_until(lambda: all(group.connected for group in groups), "attaching subscribers")
    for group in groups:
        group.freeze()
    return seen, groups


def _stop(streams: list[Stream]) -> None:
    """Stop all pipelines, and wait until they have ended, which they do concurrently."""
    for stream in streams:
        stream.stop()
    for stream in streams:
        stream.join()


def _until_the_last_track(
    plan: Plan, streams: list[Stream], seen: list[Observations], schedules: list[Schedule]
) -> Iterator[float]:
    """Yield the time twenty times a second.

    It ends if the last frame of each stream was tracked, if the grace time for it is over, or if all streams failed.
    """

    def is_tracked(observations: Observations, schedule: Schedule) -> bool:
        newest = observations.tracks[-1][1].pts
        return newest is not None and schedule.number(newest) >= plan.frames - 1

    last = schedules[-1].due(plan.frames - 1)
    while (now := monotonic()) < last + _GRACE_SECONDS and any(stream.is_alive() for stream in streams):
        if now > last and all(map(is_tracked, seen, schedules)):
            break
        yield now
        time.sleep(_LOOP_SECONDS)


def _progress(plan: Plan, seen: list[Observations], passed: float) -> tuple[str, float, str]:
    latest = max(each.tracks[-1][0] - (each.tracks[-1][1].pts or 0.0) for each in seen)
    received = sum(len(each.tracks) for each in seen)
    figures = f"{received} tracks, the last {1000 * latest:.0f} ms after its frame"
    return f"{plan.frames * len(seen)} frames", min(max(passed / plan.duration, 0.0), 1.0), figures


def _pids(streams: list[Stream], groups: list[Subscribers]) -> dict[str, list[int]]:
    pids = {f"{name} {number}": [pid] for number, stream in enumerate(streams) for name, pid in stream.pids.items()}
    readers = [pid for group in groups for pid in group.pids]
    return pids | ({"subscribers": readers} if readers else {})

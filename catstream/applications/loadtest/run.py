"""One run of a load test: starts the processes, runs the schedule, and collects the measurements."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from os import getpid
from time import monotonic

import numpy as np

from catstream.applications.loadtest.camera import Camera
from catstream.applications.loadtest.chaos import Chaos, Kill
from catstream.applications.loadtest.latencies import Latencies
from catstream.applications.loadtest.measures import Measures, measure
from catstream.applications.loadtest.observer import Observations, Observer
from catstream.applications.loadtest.plan import Plan
from catstream.applications.loadtest.stream import Stream
from catstream.applications.loadtest.subscribers import Subscribers
from catstream.applications.loadtest.usage import REST, Usage, UsageReading, summary
from catstream.errors import CatstreamError, ServiceError
from catstream.video.broadcast import Schedule

__all__ = ["LEAD_SECONDS", "Monitor", "Recovery", "Result", "Status", "recovery", "run", "wait_until"]

_START_TIMEOUT_SECONDS = 120.0  # for each phase of the start
LEAD_SECONDS = 0.5  # from the end of the start to the first frame
_GRACE_SECONDS = 3.0  # to wait for the track of the last frame
_NO_KILL_SECONDS = 5.0  # no kills this long before the last frame, so that killed processes can recover
_READING_SECONDS = 0.5  # between two readings of processor and memory use
_LOOP_SECONDS = 0.05


@dataclass(frozen=True, slots=True)
class Status:
    """Progress of a run: current activity, share of it that is done, and current figures."""

    activity: str
    share: float
    figures: str = ""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Seconds from a kill to the next track of a later frame, and to the next model; None if there was none."""

    kill: Kill
    track: float | None
    model: float | None


@dataclass(slots=True)
class Result:
    """The results of one run.

    plan         parameters of the run
    seconds      duration of the measured frames: less than planned if the run was interrupted
    streams      measures of each stream
    restarts     total number of restarted processes
    recoveries   recovery of each kill
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
    restarts: int
    recoveries: list[Recovery]
    usage: dict[str, list[UsageReading]]
    received: list[int]
    missed: list[int]
    frozen: float
    camera_late: float
    errors: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def track(self) -> Latencies:
        """Track latencies of all streams."""
        return Latencies(np.concatenate([stream.track.seconds for stream in self.streams]))

    @property
    def model(self) -> Latencies:
        """Model latencies of all streams."""
        return Latencies(np.concatenate([stream.model.seconds for stream in self.streams]))

    @property
    def other_load(self) -> float:
        """Mean number of cores that were busy with processes outside the load test."""
        return summary(self.usage[REST])["cores"] if REST in self.usage else 0.0

    @property
    def missed_share(self) -> float:
        """Share of the frames whose tracks fast subscribers missed."""
        return sum(self.missed) / max(1, sum(self.missed) + sum(self.received))


def run(plan: Plan, camera: Camera, report_status: Callable[[Status], None] = lambda _: None) -> Result:
    """Run pipelines on the streams of a camera, and measure.

    After Ctrl-C, the measurements so far are returned.

    Parameters
    ----------
    camera : camera after `render`, with the number of streams of the plan
    report_status : function that is called about ten times a second

    Raises
    ------
    CatstreamError
        If a pipeline cannot start.
    """
    camera.show_still()
    streams = [Stream(number, url, camera.boxes, plan.settings) for number, url in enumerate(camera.urls)]
    with ExitStack() as stack:
        observer, groups = _started(plan, streams, stack, report_status)
        schedules = camera.play(Schedule(monotonic() + LEAD_SECONDS, plan.rate, plan.frames))
        chaos = Chaos(plan.settings.run.seed) if plan.chaos else None
        last_kill = schedules[-1].due(plan.frames - 1) - _NO_KILL_SECONDS

        def turn() -> bool:
            if chaos is not None and monotonic() < last_kill:
                chaos.step(streams)
            return any(stream.is_alive() for stream in streams)

        kills = chaos.kills if chaos is not None else []
        monitor = Monitor(plan, camera, observer.observations, kills, turn, lambda: _pids(streams, groups))
        interrupted = False
        try:
            monitor.run(schedules, report_status)
        except KeyboardInterrupt:
            interrupted = True
        end = monotonic()
        late, frozen_seconds = camera.late, max((group.frozen_seconds for group in groups), default=0.0)
        report_status(Status("ending", 1.0))
        _ask_to_stop(streams)
        for stream in streams:
            stream.stop()
        for group in groups:
            group.wait()
        observer.end()
    due = [min(plan.frames, schedule.following(end)) if interrupted else plan.frames for schedule in schedules]
    if not all(number > 0 for number in due):
        raise KeyboardInterrupt
    figures = [
        measure(observations, schedule, number, camera.truth, end, stream.totals)
        for observations, schedule, number, stream in zip(observer.observations, schedules, due, streams, strict=True)
    ]
    return Result(
        plan=plan,
        seconds=min(due) / plan.rate,
        streams=figures,
        restarts=sum(stream.restarts for stream in streams),
        recoveries=[recovery(kill, observer.observations[kill.stream]) for kill in kills],
        usage=monitor.usage.readings,
        received=[count for group in groups for count in group.received()],
        missed=[count for group in groups for count in group.missed()],
        frozen=frozen_seconds,
        camera_late=late,
        errors=[f"stream {number}: {stream.error}" for number, stream in enumerate(streams) if stream.error],
        interrupted=interrupted,
    )


def _started(
    plan: Plan, streams: list[Stream], stack: ExitStack, report_status: Callable[[Status], None]
) -> tuple[Observer, list[Subscribers]]:
    """Start the pipelines, wait for their first models, then connect the subscribers; the stack ends all of them."""

    def errors() -> list[CatstreamError | None]:
        return [stream.error for stream in streams]

    for stream in streams:
        stack.callback(stream.stop)
        stream.start()
    stack.callback(_ask_to_stop, streams)
    wait_until(lambda: all(stream.ready.is_set() for stream in streams), errors, "starting processes", report_status)
    keys = plan.settings.run.keys
    observer = Observer([stream.endpoint for stream in streams], keys)
    observer.start()
    stack.callback(observer.end)
    seen = observer.observations
    wait_until(lambda: all(each.warmed_up for each in seen), errors, "learning the first models", report_status)
    counts = {"readers": plan.subscribers, "slow": plan.slow - plan.frozen, "frozen": plan.frozen}
    groups = [stack.enter_context(Subscribers(stream.endpoint, keys=keys, **counts)) for stream in streams]
    wait_until(lambda: all(group.connected for group in groups), errors, "attaching subscribers", report_status)
    for group in groups:
        group.freeze()
    return observer, groups


class Monitor:
    """Runs the loop during the schedule: readings of the processes, and status reports.

    Parameters
    ----------
    observations : of each stream, while they are made
    kills : the kills so far
    turn : called about twenty times a second; returns whether to go on: false if all streams have failed
    pids : ids of the processes by name, without the camera and this process

    Attributes
    ----------
    usage : readings of the processes
    """

    def __init__(
        self,
        plan: Plan,
        camera: Camera,
        observations: list[Observations],
        kills: list[Kill],
        turn: Callable[[], bool],
        pids: Callable[[], dict[str, list[int]]],
    ) -> None:
        self._plan, self._camera, self._seen, self._kills = plan, camera, observations, kills
        self._turn, self._pids = turn, pids
        self._last_reading = 0.0
        self.usage = Usage()

    def run(self, schedules: list[Schedule], report_status: Callable[[Status], None]) -> None:
        """Run until the last frame is tracked or its grace time is over, or all streams have failed."""
        frames, last = self._plan.frames, schedules[-1].due(self._plan.frames - 1)
        while (now := monotonic()) < last + _GRACE_SECONDS and self._turn():
            if now > last and all(map(self._all_tracked, self._seen, schedules)):
                break
            if now - self._last_reading >= _READING_SECONDS:
                self._last_reading = now
                own = {"camera": [self._camera.pid], "load test": [getpid()]}
                self.usage.read(now, self._pids() | own)
            passed = min(max(now - schedules[0].start, 0.0), self._plan.duration)
            latest = max(
                observations.tracks[-1][0] - (observations.tracks[-1][1].pts or 0.0) for observations in self._seen
            )
            received = sum(len(observations.tracks) for observations in self._seen)
            killed = f", {len(self._kills)} killed" if self._plan.chaos else ""
            figures = f"{received} tracks, the last {1000 * latest:.0f} ms after its frame{killed}"
            report_status(Status(f"{frames * len(self._seen)} frames", passed / self._plan.duration, figures))
            time.sleep(_LOOP_SECONDS)

    def _all_tracked(self, observations: Observations, schedule: Schedule) -> bool:
        newest = observations.tracks[-1][1].pts
        return newest is not None and schedule.number(newest) >= self._plan.frames - 1


def _pids(streams: list[Stream], groups: list[Subscribers]) -> dict[str, list[int]]:
    pids = {f"{name} {number}": [pid] for number, stream in enumerate(streams) for name, pid in stream.pids.items()}
    readers = [pid for group in groups for pid in group.pids]
    return pids | ({"subscribers": readers} if readers else {})


def _ask_to_stop(streams: list[Stream]) -> None:
    """Signal all pipelines first, so that they end concurrently."""
    for stream in streams:
        stream.ask_to_stop()


def wait_until(
    condition: Callable[[], bool],
    errors: Callable[[], Iterable[CatstreamError | None]],
    activity: str,
    report_status: Callable[[Status], None],
) -> None:
    """Wait for a condition of the start. Raises the error of a stream that failed."""
    deadline = monotonic() + _START_TIMEOUT_SECONDS
    while not condition():
        for error in errors():
            if error is not None:
                raise error
        if monotonic() > deadline:
            raise ServiceError(
                f"{activity} took more than {_START_TIMEOUT_SECONDS:.0f} s: this machine is too slow or too busy, "
                "give fewer streams, subscribers or frames a second"
            )
        report_status(Status(activity, 0.0))
        time.sleep(_LOOP_SECONDS)


def recovery(kill: Kill, observations: Observations) -> Recovery:
    """Compute the recovery of a stream from a kill."""
    track = next((moment for moment, track in observations.tracks if (track.pts or 0.0) > kill.moment), None)
    model = next((moment for moment, _ in observations.models if moment > kill.moment), None)
    return Recovery(kill, *(None if moment is None else moment - kill.moment for moment in (track, model)))

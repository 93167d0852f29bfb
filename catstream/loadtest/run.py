"""One load test, from the first process to the last figure."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from os import getpid
from time import monotonic

import numpy as np

from catstream.errors import ServiceError
from catstream.loadtest.camera import Camera
from catstream.loadtest.chaos import Chaos, Kill
from catstream.loadtest.crowd import Crowd
from catstream.loadtest.latencies import Latencies
from catstream.loadtest.measures import Measures, measure
from catstream.loadtest.observer import Observer, Seen
from catstream.loadtest.plan import Plan
from catstream.loadtest.stream import Stream
from catstream.loadtest.usage import REST, Sample, Usage, summary
from catstream.video.broadcast import Schedule

__all__ = ["News", "Recovery", "Result", "run"]

_PATIENCE_SECONDS = 120.0  # for all to be ready
_LEAD_SECONDS = 0.5  # from "ready" to the first frame
_GRACE_SECONDS = 3.0  # for the track of the last frame
_CALM_SECONDS = 5.0  # before the last frame without a kill: who was killed has time to come back
_LOOK_SECONDS = 0.5  # from one sample of processor and memory to the next
_TURN_SECONDS = 0.05


@dataclass(frozen=True, slots=True)
class News:
    """How far a run is: what it is doing, the share of that which is done, and figures of the moment."""

    doing: str
    share: float
    figures: str = ""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Seconds from a kill to the next track of a later frame, and to the next model; None where none came."""

    kill: Kill
    track: float | None
    model: float | None


@dataclass(slots=True)
class Result:
    """What one run gave.

    plan         what was asked
    seconds      of frames that were measured: less than asked where it was interrupted
    streams      figures of each
    restarts     of processes, in all
    recoveries   of each kill
    usage        processor and memory of each process, and of all that is not of the load test
    heard        tracks that each quick subscriber heard, and missed
    frozen       seconds for which the frozen subscribers were that
    camera_late  seconds by which the camera itself sent a frame too late at most
    errors       of streams that failed
    interrupted  whether it was stopped before its end
    """

    plan: Plan
    seconds: float
    streams: list[Measures]
    restarts: int
    recoveries: list[Recovery]
    usage: dict[str, list[Sample]]
    heard: list[int]
    missed: list[int]
    frozen: float
    camera_late: float
    errors: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def track(self) -> Latencies:
        """Of the frames of all streams."""
        return Latencies(np.concatenate([stream.track.seconds for stream in self.streams]))

    @property
    def model(self) -> Latencies:
        """The same to the model that has seen them."""
        return Latencies(np.concatenate([stream.model.seconds for stream in self.streams]))

    @property
    def others(self) -> float:
        """Cores that were busy with what is not of the load test, on average."""
        return summary(self.usage[REST])["cores"] if REST in self.usage else 0.0

    @property
    def missed_share(self) -> float:
        """Of the tracks that quick subscribers should have heard."""
        return sum(self.missed) / max(1, sum(self.missed) + sum(self.heard))


def run(plan: Plan, camera: Camera, tell: Callable[[News], None] = lambda _: None) -> Result:
    """Run pipelines on what a camera broadcasts, and measure.

    Ctrl-C ends it early: what was measured so far is returned.

    Parameters
    ----------
    camera : one that has rendered, and has as many streams
    tell : called ten times a second or so

    Raises
    ------
    CatstreamError
        Where it could not begin.
    """
    camera.stand_still()
    streams = [Stream(number, url, camera.box, plan.settings) for number, url in enumerate(camera.urls)]
    with ExitStack() as stack:
        for stream in streams:
            stack.callback(stream.stop)
            stream.start()
        stack.callback(_ask_to_stop, streams)
        _until(lambda: all(stream.ready.is_set() for stream in streams), streams, "starting processes", tell)
        observer = Observer([stream.endpoint for stream in streams], plan.settings.run.keys)
        observer.start()
        stack.callback(observer.end)
        _until(lambda: all(seen.warm for seen in observer.seen), streams, "learning the first models", tell)
        gather = partial(
            Crowd,
            readers=plan.subscribers,
            slow=plan.slow - plan.frozen,
            frozen=plan.frozen,
            keys=plan.settings.run.keys,
        )
        crowds = [stack.enter_context(gather(stream.endpoint)) for stream in streams]
        _until(lambda: all(crowd.attached for crowd in crowds), streams, "attaching subscribers", tell)
        for crowd in crowds:
            crowd.freeze()

        schedules = camera.play(Schedule(monotonic() + _LEAD_SECONDS, plan.rate, plan.frames))
        watch = _Watch(plan, camera, streams, crowds, observer)
        interrupted = False
        try:
            watch.until_the_end(schedules, tell)
        except KeyboardInterrupt:
            interrupted = True
        end = monotonic()
        late, frozen_seconds = camera.late, max((crowd.frozen_seconds for crowd in crowds), default=0.0)
        tell(News("ending", 1.0))
        _ask_to_stop(streams)
        for stream in streams:
            stream.stop()
        for crowd in crowds:
            crowd.wait()
        observer.end()
    due = [min(plan.frames, schedule.following(end)) if interrupted else plan.frames for schedule in schedules]
    if not all(number > 0 for number in due):
        raise KeyboardInterrupt
    figures = [
        measure(seen, schedule, number, camera.truth, end, stream.totals)
        for seen, schedule, number, stream in zip(observer.seen, schedules, due, streams, strict=True)
    ]
    return Result(
        plan=plan,
        seconds=min(due) / plan.rate,
        streams=figures,
        restarts=sum(stream.restarts for stream in streams),
        recoveries=[_recovery(kill, observer.seen[kill.stream]) for kill in watch.kills],
        usage=watch.usage.samples,
        heard=[count for crowd in crowds for count in crowd.heard()],
        missed=[count for crowd in crowds for count in crowd.missed()],
        frozen=frozen_seconds,
        camera_late=late,
        errors=[f"stream {number}: {stream.error}" for number, stream in enumerate(streams) if stream.error],
        interrupted=interrupted,
    )


class _Watch:
    """What goes on while frames come: samples, chaos, and news."""

    def __init__(
        self, plan: Plan, camera: Camera, streams: list[Stream], crowds: list[Crowd], observer: Observer
    ) -> None:
        self._plan, self._camera, self._streams, self._crowds = plan, camera, streams, crowds
        self._seen = observer.seen
        self._chaos = Chaos(plan.settings.run.seed) if plan.chaos else None
        self._looked = 0.0
        self.usage = Usage()

    @property
    def kills(self) -> list[Kill]:
        return self._chaos.kills if self._chaos else []

    def until_the_end(self, schedules: list[Schedule], tell: Callable[[News], None]) -> None:
        """Until the last frame has its track, or was given up, or all streams have failed."""
        frames, last = self._plan.frames, schedules[-1].due(self._plan.frames - 1)
        while (now := monotonic()) < last + _GRACE_SECONDS and any(stream.is_alive() for stream in self._streams):
            if now > last and all(map(self._through, self._seen, schedules)):
                break
            if now - self._looked >= _LOOK_SECONDS:
                self._looked = now
                self.usage.look(now, self._pids())
            if self._chaos and now < last - _CALM_SECONDS:
                self._chaos.turn(self._streams)
            passed = min(max(now - schedules[0].start, 0.0), self._plan.duration)
            latest = max(seen.tracks[-1][0] - (seen.tracks[-1][1].pts or 0.0) for seen in self._seen)
            heard = sum(len(seen.tracks) for seen in self._seen)
            killed = f", {len(self.kills)} killed" if self._chaos else ""
            figures = f"{heard} tracks, the last {1000 * latest:.0f} ms after its frame{killed}"
            tell(News(f"{frames * len(self._streams)} frames", passed / self._plan.duration, figures))
            time.sleep(_TURN_SECONDS)

    def _through(self, seen: Seen, schedule: Schedule) -> bool:
        newest = seen.tracks[-1][1].pts
        return newest is not None and schedule.number(newest) >= self._plan.frames - 1

    def _pids(self) -> dict[str, list[int]]:
        pids = {
            f"{name} {number}": [pid]
            for number, stream in enumerate(self._streams)
            for name, pid in stream.pids.items()
        }
        pids |= {"camera": [self._camera.pid], "this process": [getpid()]}
        readers = [pid for crowd in self._crowds for pid in crowd.pids]
        return pids | ({"subscribers": readers} if readers else {})


def _ask_to_stop(streams: list[Stream]) -> None:
    """All of them, so that they end side by side."""
    for stream in streams:
        stream.ask_to_stop()


def _until(condition: Callable[[], bool], streams: list[Stream], doing: str, tell: Callable[[News], None]) -> None:
    """Wait for something that all streams need to begin."""
    deadline = monotonic() + _PATIENCE_SECONDS
    while not condition():
        for stream in streams:
            if stream.error is not None:
                raise stream.error
        if monotonic() > deadline:
            raise ServiceError(
                f"{doing} took more than {_PATIENCE_SECONDS:.0f} s: this machine is too slow or too busy, "
                "give fewer streams, subscribers or frames a second"
            )
        tell(News(doing, 0.0))
        time.sleep(_TURN_SECONDS)


def _recovery(kill: Kill, seen: Seen) -> Recovery:
    track = next((moment for moment, track in seen.tracks if (track.pts or 0.0) > kill.moment), None)
    model = next((moment for moment, _ in seen.models if moment > kill.moment), None)
    return Recovery(kill, *(None if moment is None else moment - kill.moment for moment in (track, model)))

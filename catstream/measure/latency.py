"""Latencies of a stream under load, and the use of processor and memory.

Every due frame counts once, tracked or skipped. Its track latency ends with the first track of this or a newer frame;
its model latency ends with the first model whose training sample includes this or a newer frame. Therefore skipping
frames while a pipeline is slow does not improve its figures (no coordinated omission).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from threading import Event, Thread
from time import monotonic
from typing import NamedTuple

import numpy as np
import psutil

from catstream.base.arrays import Float64
from catstream.client.address import Address
from catstream.client.attach import subscribe
from catstream.errors import SilenceError
from catstream.measure.camera import Schedule
from catstream.measure.rtsp import due_time
from catstream.measure.scores import overlaps, present
from catstream.wire.messages import Model, Track

#: The reported percentiles of latencies, by name.
PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}

#: Name for other processes of this machine. If their load is high, the figures of a load test are unreliable.
REST = "everything else"

_POLL_SECONDS = 0.1
_MEMORY_SECONDS = 5.0  # interval between two readings of memory
_SUCCESS = 0.5  # IoU above which a frame is a success


@dataclass(slots=True)
class Observations:
    """The messages of one pipeline with their arrival times by `time.monotonic`, oldest first.

    tracks  tracks of frames with a time stamp, in order of arrival, each with the due time of its frame as `pts`
    models  due time of the newest training frame of each model, if its track has arrived
    first_motion_version  version of the first model with a motion model, 0 before it
    """

    tracks: list[tuple[float, Track]] = field(default_factory=list)
    models: list[tuple[float, float]] = field(default_factory=list)
    first_motion_version: int = 0
    _due: dict[int, float] = field(default_factory=dict)  # by frame number; a restarted detector may reuse numbers

    @property
    def warmed_up(self) -> bool:
        """True once the detector uses a model with a motion model."""
        first = self.first_motion_version
        return first > 0 and bool(self.tracks) and self.tracks[-1][1].model_version >= first

    def add(self, moment: float, message: Track | Model) -> None:
        match message:
            case Track(pts=float(pts)):
                due = self._due[message.frame] = due_time(pts, moment)
                self.tracks.append((moment, replace(message, pts=due)))
            case Model():
                if message.frame in self._due:
                    self.models.append((moment, self._due[message.frame]))
                if message.motion is not None:
                    self.first_motion_version = self.first_motion_version or message.version


@contextmanager
def observed(address: Address, name: str) -> Iterator[Observations]:
    """Observe one object of a pipeline in threads until the context or the pipeline ends."""
    observations, ended = Observations(), Event()

    def observe(channel: str) -> None:
        with subscribe(address, channel, object=name, timeout=_POLL_SECONDS) as messages:
            while not ended.is_set():
                try:
                    message = next(messages)
                except SilenceError:
                    continue
                except StopIteration:
                    return
                observations.add(monotonic(), message)

    threads = [
        Thread(target=observe, args=(channel,), name=f"observer of {channel}", daemon=True)
        for channel in ("tracks", "models")
    ]
    for thread in threads:
        thread.start()
    try:
        yield observations
    finally:
        ended.set()
        for thread in threads:
            thread.join()


@dataclass(slots=True)
class Measures:
    """The measures of one stream.

    due              due time of each frame, float64 (frames,)
    tracked          whether each frame has a track, bool (frames,)
    track            seconds from the due time of each frame to the track of this or a newer frame, or to the end of the
                     run
    model            seconds to the model trained on this or a newer frame
    success          share of frames with the object whose box has an IoU above 0.5 with the ground truth or with the
                     unloaded run; a skipped frame has the box of the last tracked frame
    totals           totals of the pipeline at its end; empty if the stream has not ended
    """

    due: Float64
    tracked: np.ndarray
    track: Float64
    model: Float64
    success: float
    totals: dict[str, int] = field(default_factory=dict)

    @property
    def skipped(self) -> float:
        """Share of frames without a track."""
        return 1 - float(self.tracked.mean())

    @property
    def figures(self) -> dict[str, float]:
        """The figures that can have a limit, by name."""
        model = {f"model-{name}": seconds for name, seconds in percentiles(self.model).items()}
        return {**percentiles(self.track), **model, "skipped": self.skipped, "success": self.success}


@dataclass(slots=True)
class Receipts:
    """The measures of one or more fast subscribers to a channel of a stream.

    latency   seconds from the due time of each frame to the receipt of a message of this or a newer frame, or to the
              end of the run; float32 (subscribers, frames)
    received  number of received frames of each subscriber since it connected
    missed    number of missed frames of each subscriber, by the gaps in `frame`; 0 on a channel that keeps only the
              newest message
    """

    stream: int
    channel: str
    latency: np.ndarray
    received: list[int]
    missed: list[int]

    @property
    def figures(self) -> dict[str, float]:
        """The figures that can have a limit, by name."""
        latencies = {f"subscriber-{name}": seconds for name, seconds in percentiles(self.latency).items()}
        return latencies | {"subscriber-missed": sum(self.missed) / max(1, sum(self.missed) + sum(self.received))}


def measure(
    observations: Observations,
    schedule: Schedule,
    frames: int,
    truth: Float64,
    end: float,
    totals: dict[str, int],
    images: int | None = None,
) -> Measures:
    """Compute the measures of one stream.

    frames : number of due frames, up to an interruption
    truth : boxes of the object in the first frames, float64 (n, 4), NaN if it is absent; the last `images` boxes, by
        default all, are repeated
    end : time at which the observation ended
    totals : totals of the pipeline at its end
    """
    # Step 1: the box of each frame; a skipped frame has the box of the last tracked frame.
    due = schedule.due_times(frames)
    tracks = [(moment, schedule.number(track.pts or 0.0)) for moment, track in observations.tracks]
    tracked = np.isin(np.arange(frames), [number for _, number in tracks])
    boxes = np.full((frames + 1, 4), np.nan)  # the last row, NaN, is for frames before the first tracked one
    for (_, number), (_, track) in zip(tracks, observations.tracks, strict=True):
        if 0 <= number < frames:
            boxes[number] = track.box or np.nan
    last = np.maximum.accumulate(np.where(tracked, np.arange(frames), -1))
    # Step 2: compare with the ground truth, which repeats with the video.
    period = images or len(truth)
    once, numbers = len(truth) - period, np.arange(frames)
    true = truth[np.where(numbers < once, numbers, once + (numbers - once) % period)]
    is_success = overlaps(boxes[last], true)[present(true)] > _SUCCESS
    models = [(moment, schedule.number(newest)) for moment, newest in observations.models]
    return Measures(
        due=due,
        tracked=tracked,
        track=latencies_to_answer(due, tracks, end),
        model=latencies_to_answer(due, models, end),
        success=float(is_success.mean()) if is_success.size else 1.0,  # interrupted before a frame with the object
        totals=totals,
    )


def percentiles(seconds: np.ndarray) -> dict[str, float]:
    """Return the `PERCENTILES` of one or more latencies, without interpolation.

    >>> percentiles(np.array([0.010] * 98 + [0.5, 2.0]))["p99"]
    0.5
    """
    values = np.percentile(seconds, list(PERCENTILES.values()), method="inverted_cdf")
    return dict(zip(PERCENTILES, values.tolist(), strict=True))


def latencies_to_answer(due: Float64, answers: list[tuple[float, int]], end: float) -> Float64:
    """Return the seconds from each frame's due time to the first answer for this or a newer frame, float64 (frames,).

    due : due times, float64 (frames,)
    answers : arrival time and frame number of each answer
    end : assumed arrival time for frames without an answer

    >>> latencies_to_answer(np.array([0.0, 1.0, 2.0, 3.0]), [(0.5, 0), (2.5, 2)], end=9.0)
    array([0.5, 1.5, 0.5, 6. ])
    """
    first = np.full(len(due), np.inf)
    for moment, number in answers:
        if number >= 0:
            index = min(number, len(due) - 1)
            first[index] = min(first[index], moment)
    first = np.minimum.accumulate(first[::-1])[::-1]
    return np.asarray(np.minimum(first, end) - due)


class Reading(NamedTuple):
    """The use of the processor and of memory by named groups of processes.

    moment   time by `time.monotonic`
    seconds  seconds since the previous reading
    cores    mean number of busy cores since then by name, and of `REST`
    memory   proportional set size (PSS) in bytes by name; empty if it was not read
    """

    moment: float
    seconds: float
    cores: dict[str, float]
    memory: dict[str, int]


class Usage:
    """Readings of named groups of processes, oldest first; the process ids of a group may change.

    Memory is read every five seconds, because each process takes the kernel milliseconds.
    """

    def __init__(self) -> None:
        self.readings: list[Reading] = []
        self._processes: dict[int, psutil.Process] = {}  # store the processor time of the previous reading
        self._moment = self._memory_at = 0.0

    def read(self, groups: Mapping[str, Iterable[int]], *, is_last: bool = False) -> None:
        """Add a reading of groups of process ids; the first call only starts the measurement."""
        is_first, previous, self._moment = not self._processes, self._moment, monotonic()
        all_cores = psutil.cpu_percent() / 100 * (psutil.cpu_count() or 1)
        cores, memory = dict.fromkeys(groups, 0.0), dict.fromkeys(groups, 0)
        with_memory = not is_first and (is_last or self._moment >= self._memory_at)
        for name, pid in ((name, pid) for name, pids in groups.items() for pid in pids):
            with suppress(psutil.Error):  # the process has just ended
                process = self._processes.setdefault(pid, psutil.Process(pid))
                cores[name] += process.cpu_percent() / 100
                memory[name] += process.memory_full_info().pss if with_memory else 0
        if is_first:
            return
        if with_memory:
            self._memory_at = self._moment + _MEMORY_SECONDS
        cores[REST] = max(0.0, all_cores - sum(cores.values()))
        self.readings.append(Reading(self._moment, self._moment - previous, cores, memory if with_memory else {}))

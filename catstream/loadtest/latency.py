"""Observations of a stream under load, and their measures; and the use of processor and memory.

Every due frame counts once, tracked or skipped. Its track latency ends with the first track of this frame or a newer
one; its model latency ends with the first model whose training sample includes this frame or a newer one. Thus a
pipeline does not get better figures by skipping frames while it is slow (no coordinated omission).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from threading import Event, Thread
from time import monotonic

import numpy as np
import psutil

from catstream.base.arrays import Float64
from catstream.client.address import Address
from catstream.client.attach import subscribe
from catstream.errors import SilenceError
from catstream.evaluation.scores import overlaps
from catstream.loadtest.camera import Schedule
from catstream.loadtest.rtsp import due_time
from catstream.messages.kinds import Health, Model, Track

#: The percentiles of latencies that are reported, by name.
PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}

#: Name of the load by other processes of this machine. If it is high, the figures of a load test are unreliable.
REST = "everything else"

_POLL_SECONDS = 0.1
_SUCCESS = 0.5  # a frame with a larger overlap with the ground truth is a success


@dataclass(slots=True)
class Observations:
    """The messages of one pipeline with their arrival times by `time.monotonic`, oldest first.

    tracks  tracks in order of arrival; a restarted detector may repeat a number with another frame
    models  newest training frame of each model, numbered as the tracks were at its arrival
    health  health reports of all processes
    first_motion_version  version of the first model with a motion model, 0 before it
    """

    tracks: list[tuple[float, Track]] = field(default_factory=list)
    models: list[tuple[float, int]] = field(default_factory=list)
    health: list[tuple[float, Health]] = field(default_factory=list)
    first_motion_version: int = 0

    @property
    def warmed_up(self) -> bool:
        """True if the start-up phase is over: the detector uses a model with a motion model."""
        return (
            self.first_motion_version > 0
            and bool(self.tracks)
            and self.tracks[-1][1].model_version >= self.first_motion_version
        )

    def add(self, moment: float, message: Track | Model | Health) -> None:
        if isinstance(message, Track):
            if message.pts is not None:
                message = replace(message, pts=due_time(message.pts, moment))
            self.tracks.append((moment, message))
        elif isinstance(message, Model):
            self.models.append((moment, message.frame))
            if message.motion is not None:
                self.first_motion_version = self.first_motion_version or message.version
        else:
            self.health.append((moment, message))


@contextmanager
def observed(addresses: Sequence[Address], name: str) -> Iterator[list[Observations]]:
    """Observe one object of each pipeline in threads, which end with the context or with their pipelines."""
    streams, ended = [Observations() for _ in addresses], Event()

    def observe(address: Address, channel: str, observations: Observations) -> None:
        about = None if channel == "health" else name
        with subscribe(address, channel, object=about, timeout=_POLL_SECONDS) as messages:
            while not ended.is_set():
                try:
                    message = next(messages)
                except SilenceError:
                    continue
                except StopIteration:
                    return
                observations.add(monotonic(), message)

    threads = [
        Thread(target=observe, args=(address, channel, stream), name=f"observer of {channel}", daemon=True)
        for address, stream in zip(addresses, streams, strict=True)
        for channel in ("tracks", "models", "health")
    ]
    for thread in threads:
        thread.start()
    try:
        yield streams
    finally:
        ended.set()
        for thread in threads:
            thread.join()


@dataclass(slots=True)
class Measures:
    """The measures of one stream.

    due              due time of each frame, float64 (frames,)
    followed         whether each frame has a track, bool (frames,)
    track            seconds from the due time of each frame to the track of this frame or a newer one
    model            seconds to the model trained on this frame or a newer one
    without_track    frames without such a track until the end of the run, which counts as their arrival
    success          share of frames with the object whose overlap is above 0.5; a skipped frame has the last known box
    success_followed the same share of the tracked frames alone; None if there are none
    max_lag          largest number of messages that the compressor had not received
    totals           those of the pipeline at its end; empty if the stream has not ended
    """

    due: Float64
    followed: np.ndarray
    track: Float64
    model: Float64
    without_track: int
    success: float | None
    success_followed: float | None
    max_lag: int = 0
    totals: dict[str, int] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        return len(self.due)

    @property
    def skipped(self) -> int:
        """Number of frames without a track of their own."""
        return self.frames - int(self.followed.sum())

    @property
    def skipped_share(self) -> float:
        return self.skipped / self.frames

    def rate(self, rate: float) -> float:
        """Return the tracked frames per second if `rate` frames per second were due."""
        return rate * (1 - self.skipped_share)

    @property
    def not_stored(self) -> int | None:
        """Number of features messages that are in no coreset tree at the end; None if the stream has not ended."""
        return self.totals["sent"] - self.totals["stored"] if self.totals else None


def measure(
    observations: Observations, schedule: Schedule, frames: int, truth: np.ndarray, end: float, totals: dict[str, int]
) -> Measures:
    """Compute the measures of one stream.

    frames : number of due frames: all of the schedule of the camera, or those before an interruption
    truth : ground truth, float64 (pictures, 4), NaN if the object is absent
    end : time at which the observation ended
    totals : totals of the pipeline at its end
    """
    due = np.array([schedule.due(number) for number in range(frames)])
    tracks = [
        (moment, track, schedule.number(track.pts)) for moment, track in observations.tracks if track.pts is not None
    ]
    to_track, without_track = latencies_to_answer(due, [(moment, number) for moment, _, number in tracks], end)
    to_model, _ = latencies_to_answer(due, _models(observations, schedule), end)
    boxes = np.full((frames, 4), np.nan)
    followed = np.zeros(frames, bool)
    for _, track, number in tracks:
        if 0 <= number < frames:
            boxes[number], followed[number] = track.box or np.nan, True
    true = truth[[schedule.picture(number, len(truth)) for number in range(frames)]]
    return Measures(
        due=due,
        followed=followed,
        track=to_track,
        model=to_model,
        without_track=without_track,
        success=_success(carried_forward(boxes, followed), true),
        success_followed=_success(boxes[followed], true[followed]),
        max_lag=max(
            (
                int(health.counters["sent"] - health.counters["processed"])
                for moment, health in observations.health
                if health.process == "detector" and schedule.start <= moment <= end
            ),
            default=0,
        ),
        totals=totals,
    )


def percentiles(seconds: Float64) -> dict[str, float]:
    """Return the `PERCENTILES` of at least one latency; each of them is the latency of a frame.

    >>> percentiles(np.array([0.010] * 98 + [0.5, 2.0]))["p99"]
    0.5
    """
    values = np.percentile(seconds, list(PERCENTILES.values()), method="inverted_cdf")
    return dict(zip(PERCENTILES, values.tolist(), strict=True))


def latencies_to_answer(due: Float64, answers: list[tuple[float, int]], end: float) -> tuple[Float64, int]:
    """Return the seconds from each frame's due time to the first answer for this or a newer frame, float64 (frames,).

    due : due times, float64 (frames,)
    answers : arrival time and frame number of each answer
    end : arrival time that is assumed for frames without an answer, whose number is returned, too

    >>> latencies_to_answer(np.array([0.0, 1.0, 2.0, 3.0]), [(0.5, 0), (2.5, 2)], end=9.0)
    (array([0.5, 1.5, 0.5, 6. ]), 1)
    """
    first = np.full(len(due), np.inf)
    for moment, number in answers:
        if number >= 0:
            place = min(number, len(due) - 1)
            first[place] = min(first[place], moment)
    first = np.minimum.accumulate(first[::-1])[::-1]
    return np.minimum(first, end) - due, int(np.isinf(first).sum())


def carried_forward(boxes: np.ndarray, followed: np.ndarray) -> np.ndarray:
    """Return the last known box at each frame: its own, or that of the last tracked frame before it.

    >>> carried_forward(np.array([[1.0], [2.0], [3.0]]), np.array([False, True, False])).ravel()
    array([nan,  2.,  2.])
    """
    last = np.maximum.accumulate(np.where(followed, np.arange(len(boxes)), -1))
    return np.where(last[:, None] >= 0, boxes[last], np.nan)


def _success(boxes: np.ndarray, truth: np.ndarray) -> float | None:
    present = np.isfinite(truth).all(axis=1)
    return float((overlaps(boxes, truth)[present] > _SUCCESS).mean()) if present.any() else None


def _models(observations: Observations, schedule: Schedule) -> list[tuple[float, int]]:
    """Return the arrival time of each model, and the newest frame of its sample as a number of the schedule.

    After a restart, the detector reuses the numbers of frames that were lost. The mapping from its frame numbers to the
    schedule therefore depends on the time.
    """
    number_of_frame: dict[int, int] = {}
    models, tracks = [], iter(observations.tracks)
    ahead = next(tracks, None)
    for moment, frame in observations.models:
        while ahead is not None and ahead[0] <= moment:
            if ahead[1].pts is not None:
                number_of_frame[ahead[1].frame] = schedule.number(ahead[1].pts)
            ahead = next(tracks, None)
        if frame in number_of_frame:
            models.append((moment, number_of_frame[frame]))
    return models


class Usage:
    """Processor use of named groups of processes; after a restart, the process ids of a group may change.

    readings  mean number of busy cores since the reading before, by name, and of `REST`, oldest first
    """

    def __init__(self) -> None:
        self.readings: dict[str, list[float]] = {}
        self._processes: dict[int, psutil.Process] = {}  # psutil keeps the processor time of the previous reading in it

    def read(self, groups: Mapping[str, Iterable[int]]) -> None:
        """Add a reading of groups of process ids; the first call only starts the measurement."""
        is_first = not self._processes
        all_cores = psutil.cpu_percent() / 100 * (psutil.cpu_count() or 1)
        cores = {name: sum(map(self._cores, pids)) for name, pids in groups.items()}
        if not is_first:
            for name, reading in (cores | {REST: max(0.0, all_cores - sum(cores.values()))}).items():
                self.readings.setdefault(name, []).append(reading)

    def _cores(self, pid: int) -> float:
        """Return the busy cores of a process; 0 if it has just ended."""
        try:
            self._processes[pid] = self._processes.get(pid) or psutil.Process(pid)
            return float(self._processes[pid].cpu_percent() / 100)
        except psutil.Error:
            return 0.0


def proportional_memory(pids: Iterable[int]) -> int:
    """Return the bytes of these processes (PSS): a page that n processes share counts as 1/n of a page in each."""
    total = 0
    for pid in pids:
        with suppress(psutil.Error):  # it has just ended
            total += psutil.Process(pid).memory_full_info().pss
    return total

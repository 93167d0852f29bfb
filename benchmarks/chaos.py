"""Injects a random schedule of faults into a running pipeline, and checks that no track and no row is lost.

One fault follows the other: processes are killed (kill -9) or frozen (SIGSTOP), the disk is full, or the clock is
wrong. A process that dies is started again at once, as by systemd. With several objects, some are forgotten and others
begin between the faults. Every frame must have exactly one track, and every row must be in the trees exactly once; the
success rate must be as high as without faults. In lockstep it is also shown whether tracks and trees are the same, bit
for bit, as without faults.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Self
from unittest.mock import patch

import cv2
import numpy as np
from sequences import FIRST, named, objects, scratch
from table import Table, benchmark, command

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.client.attach import control
from catstream.client.control import Control
from catstream.coreset.forest import Forest
from catstream.errors import ServiceError
from catstream.measure.datasets import Sequence
from catstream.measure.scores import score
from catstream.multi import MultiTracker
from catstream.processes.job import Job
from catstream.processes.process import PERMANENT_FAILURE
from catstream.processes.start_server import NAMES, close_start_server, start_server
from catstream.processes.supervisor import Child
from catstream.video.source import open_source
from catstream.wire.channels import MODELS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import Answer, End, Track, Tracks
from catstream.wire.newest import Subscriber
from catstream.wire.results import ResultsReceiver

_PATIENCE_SECONDS = 120.0  # the run counts as stuck after this time without a track
_DISK = 128  # megabytes of the small disk for each object: three checkpoints, as the oldest of them is removed last
#: The module `sitecustomize` of each process. It shifts the wall clock by the seconds in a file; monotonic clocks are
#: unchanged, as they are if an administrator or NTP sets the clock. And it writes down how many rows of each message
#: belong into the trees of each object, counted without the trees: `Arena.rows_due` adds them up.
_MODULE = """
import json, os, time
from catstream.base.threads import limit_process
limit_process()  # before anything imports numpy
from catstream.coreset.forest import Forest
from catstream.wire.heads import TREES
_folder, _true, _take = os.environ["ARENA"], time.time, Forest.take
def _shifted():
    try:
        with open(_folder + "/clock") as file:
            return _true() + float(file.read() or 0)
    except OSError:
        return _true()
def _rows(part):
    found = [(tree.label, part.training[tree.group]) for tree in TREES.values() if tree.group in part.training]
    return sum(len(rows) if label is None else int((rows.labels == label).sum()) for label, rows in found)
def _counted(self, features, *more):
    if features.seq == self.seq + 1:
        parts = {name: [part.begins, _rows(part)] for name, part in features.objects.items()}
        with open(_folder + "/rows", "a") as file:
            file.write(json.dumps([features.seq, parts]) + chr(10))
    return _take(self, features, *more)
time.time, Forest.take = _shifted, _counted
"""
CALM = (1, 6)  # frames between a recovery and the next fault
LAST = 20  # frames without faults at the end, because a process that has ended normally is not restarted
SECONDS = (0.1, 1.0)  # duration of a freeze or a full disk
HOUR = 3600.0
FULL = "disk full"
#: Columns: messages, frames with tracks, and rows in the trees, none of which may be lost or come twice.
KEPT = ("sent", "stored", "frames", "frames lost", "frames twice", "rows", "rows lost", "rows twice")
FORGET = 0.6  # probability that an object that is tracked is forgotten, and not replaced
RUNS = {"lockstep": Settings(run={"lockstep": True}), "default": Settings()}


class Arena:
    """One run of a pipeline, and the owner that receives its tracks; open it, and call `turn` until `end` is set.

    Parameters
    ----------
    source, boxes : the video, and the boxes of the objects in its first frame, by name
    state : folder for the checkpoints
    scratch : folder for logs

    Attributes
    ----------
    tracks, frames : the received tracks of each frame by name, and the number of that frame, in order
    end : the last message of the stream, None before it was received
    deaths : number of restarts of processes
    """

    def __init__(self, source: str, boxes: dict[str, Box], settings: Settings, state: Path, scratch: Path) -> None:
        self.state, self.tracks, self.frames, self.deaths = state, list[dict[str, Track]](), list[int](), 0
        self.end: End | None = None
        self.calm_from = math.inf  # frames with tracks after which no fault lasts
        self._settings, self._source, self._boxes, self._folder = settings, source, boxes, scratch
        self._children: dict[str, Child] = {}
        self._last_received = monotonic()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            endpoint = Endpoint.parse(stack.enter_context(tempfile.TemporaryDirectory(prefix="catstream-")))
            job = Job(self._source, self._boxes, settings=self._settings, run="chaos", resume=True)
            file = replace(job, state=self.state, endpoint=str(endpoint)).save(self._folder)
            (self._folder / "sitecustomize.py").write_text(_MODULE)
            window = self._settings.run.unstored_frames + 1
            self._results = stack.enter_context(ResultsReceiver(endpoint, window, 0))
            self._models = stack.enter_context(Subscriber(MODELS, endpoint))
            self._control = stack.enter_context(control(str(endpoint), timeout=_PATIENCE_SECONDS))
            self._pool = stack.enter_context(ThreadPoolExecutor(1))
            path = os.pathsep.join([str(self._folder), *filter(None, [os.environ.get("PYTHONPATH")])])
            close_start_server()  # the next one has these variables
            stack.callback(close_start_server)
            stack.enter_context(patch.dict(os.environ, {"PYTHONPATH": path, "ARENA": str(self._folder)}))
            for name in NAMES:
                self._children[name] = Child(name, file, self._folder)
                stack.callback(self._children[name].close)
                self._children[name].start(0)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def turn(self, seconds: float = 0.01) -> None:
        """Receive the tracks of the next frame, and restart processes that died.

        Raises
        ------
        ServiceError
            If no track arrives for two minutes, or a process reports an error that a restart cannot solve.
        """
        message = self._results.receive(seconds)
        if message is not None:
            self._last_received = monotonic()
            if isinstance(message, Tracks):
                self.tracks.append(message.tracks)
                self.frames.append(message.frame)
            else:
                self.end = message
            self._children["detector"].memory.consumer.read = math.inf if self.end is not None else message.seq
        elif monotonic() - self._last_received > _PATIENCE_SECONDS:
            raise ServiceError(
                f"no track arrived for {_PATIENCE_SECONDS:.0f} s after {len(self.tracks)}: {self.words()}"
            )
        for name, child in self._children.items():
            code = child.code
            if code == PERMANENT_FAILURE:
                raise ServiceError(f"the {name} gave up: {self.words()}")
            if code and self.end is None:
                self.deaths += 1
                child.start(self._results.last)

    def until(self, done: Callable[[], bool]) -> None:
        """Call `turn` until a condition is true or the run has ended."""
        while self.end is None and not done():
            self.turn()

    def run(self, seconds: float) -> None:
        """Call `turn` for some seconds, at most until the last frames, which have no faults."""
        over = monotonic() + seconds
        self.until(lambda: monotonic() >= over or len(self.tracks) >= self.calm_from)

    def finish(self) -> None:
        """Call `turn` until the stream and all processes have ended."""
        self.until(lambda: False)
        over = monotonic() + _PATIENCE_SECONDS
        while any(child.code is None for child in self._children.values()) and monotonic() < over:
            self.turn()

    def command(self, give: Callable[[Control], Answer]) -> Answer | None:
        """Give a command, and call `turn` until it is answered; None if the run has ended before."""
        answer = self._pool.submit(give, self._control)
        self.until(answer.done)
        return None if self.end is not None else answer.result()

    def taught(self) -> bool:
        """Return whether a model arrived since the last call."""
        return bool(self._models.receive_all())

    def signal(self, name: str, number: int) -> None:
        """Send a signal to a process if it runs."""
        if (process := self._children[name].process) is not None:
            process.send_signal(number)

    def kill_start_server(self) -> None:
        """Kill the process that has forked all the others; they end with it."""
        os.kill(start_server().pid, signal.SIGKILL)

    def set_clock(self, seconds: float) -> None:
        """Shift the wall clock of all processes by some seconds."""
        (self._folder / "clock").write_text(str(seconds))

    def rows_due(self) -> int:
        """Return how many rows of all messages belong into the trees of the objects that there are at the end."""
        newest: dict[int, dict[str, tuple[bool, int]]] = {}  # after a restart, messages come again
        for line in (self._folder / "rows").read_text().splitlines():
            seq, newest[seq] = json.loads(line)
        rows: dict[str, int] = {}
        for _, parts in sorted(newest.items()):
            rows = {name: count + (0 if begins else rows.get(name, 0)) for name, (begins, count) in parts.items()}
        return sum(rows.values())

    def words(self) -> str:
        """Return the last log line of each process."""
        return "; ".join(f"{name}: {child.log.last_line()}" for name, child in self._children.items())


@contextmanager
def small_disk(folder: Path, objects: int = 1) -> Iterator[Path]:
    """Mount a file system on a folder that is small, but large enough for the checkpoints of some objects; needs root.

    Raises
    ------
    OSError
        If it cannot be mounted.
    """
    folder.mkdir(exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={_DISK * objects}m,mode=0700", "catstream", str(folder)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"a small disk cannot be mounted: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


Fault = Callable[[Arena, np.random.Generator], None]


def kill(*names: str) -> Fault:
    def strike(arena: Arena, _: np.random.Generator) -> None:
        for name in names:
            arena.signal(name, signal.SIGKILL)

    return strike


def freeze(arena: Arena, random: np.random.Generator) -> None:
    name = str(random.choice(NAMES))
    arena.signal(name, signal.SIGSTOP)
    arena.run(random.uniform(*SECONDS))
    arena.signal(name, signal.SIGCONT)


def fill(arena: Arena, random: np.random.Generator) -> None:
    ballast = arena.state / "ballast"
    with ballast.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1 << 20))
        except OSError:  # no space is left
            pass
    arena.run(random.uniform(*SECONDS))
    ballast.unlink()


#: Kinds of faults, and their relative frequencies.
FAULTS: dict[str, tuple[Fault, float]] = {
    "kill -9 detector": (kill("detector"), 3),
    "kill -9 compressor": (kill("compressor"), 3),
    "kill -9 trainer": (kill("trainer"), 2),
    "kill -9 all three": (kill(*NAMES), 2),
    "kill -9 start server": (lambda arena, _: arena.kill_start_server(), 1),
    "SIGSTOP, SIGCONT": (freeze, 2),
    FULL: (fill, 1),
    "clock jump": (lambda arena, random: arena.set_clock(random.uniform(-HOUR, HOUR)), 1),
}


@dataclass(frozen=True, slots=True)
class Change:
    """A change of the objects during a run, from a frame on: an object begins at a box, or is forgotten (None)."""

    frame: int
    name: str
    box: Box | None


@dataclass(slots=True)
class Ordeal:
    """The results of a run with faults.

    recovery  of each kind of fault: seconds from its end to the next track and the next model
    tracks    of each frame, by name; and the numbers of these `frames`
    totals    features messages `sent` and `stored`, from the last message of the stream
    deaths    how often a process was started again
    learned   the forest, from the last checkpoint
    rows_due  number of the rows that must be in it
    changes   the objects that began or were forgotten between the faults
    """

    recovery: dict[str, list[float]]
    tracks: list[dict[str, Track]]
    frames: list[int]
    totals: dict[str, float]
    deaths: int
    learned: Forest
    rows_due: int
    changes: list[Change]


def figures(options: argparse.Namespace) -> Iterator[Table]:
    cycles, modes = (1, ["lockstep"]) if options.quick else (options.cycles, list(RUNS))
    source, truth = long(named(options, "TLD_01_david"), 30 if options.quick else 25 * cycles + 100)
    boxes = objects(source, Box(*map(float, truth[0])), options.objects)
    faults, times, ends = schedule(cycles, options.seed), [], []
    for label in [options.run] if options.run else modes:
        run = endure(source, boxes, RUNS[label], faults, options.seed)
        calm = undisturbed(source, boxes, run.changes)
        times += [(label, *row) for row in quantiles(run.recovery)]
        same = None if label == "default" else "yes" if identical(run, calm) else "NO"
        success = [score(found(tracks, FIRST), truth).success for tracks in (run.tracks, calm[0])]
        wrong = sum(ours.keys() != theirs.keys() for ours, theirs in zip(run.tracks, calm[0], strict=False))
        met = sum(map(len, run.recovery.values()))
        ends.append(
            (label, len(boxes), len(run.changes), wrong, met, run.deaths, *kept(run, len(truth)), *success, same)
        )
    columns = ("run", "fault", "times", "p50 s", "p99 s", "slowest s")
    yield Table("Recovery", columns, times, "from the end of a fault to the track two frames further, or a new model")
    columns = (
        "run",
        "objects",
        "changes",
        "wrong",
        "faults",
        "restarts",
        *KEPT,
        "success",
        "without",
        "trees the same",
    )
    note = f"""seed {options.seed}; changes: objects that began or were forgotten
wrong: frames whose tracks are of other objects than without faults; sent, stored: messages of features
rows: in the trees; lost, twice: of the rows of all messages, which are counted without the trees
without: in one process, without faults"""
    yield Table(f"{len(truth)} frames", columns, ends, note)


def kept(run: Ordeal, frames: int) -> tuple[int, ...]:
    """Return the columns `KEPT` of a run over a number of frames."""
    seen, rows = set(run.frames), int(run.learned.counters()["rows"])
    messages = (int(run.totals[name]) for name in ("sent", "stored"))
    lost, twice = frames - len(seen), len(run.frames) - len(seen)
    return *messages, len(run.frames), lost, twice, rows, max(run.rows_due - rows, 0), max(rows - run.rows_due, 0)


def long(sequence: Sequence, frames: int) -> tuple[str, np.ndarray]:
    """Some frames of a sequence, forwards and backwards as often as it takes, as a folder; and their boxes."""
    folder = scratch() / "frames"
    folder.mkdir()
    order = len(sequence) - 1 - abs(np.arange(frames) % (2 * len(sequence) - 2) - (len(sequence) - 1))
    for number, image in zip(range(order.max() + 1), sequence.frames(), strict=False):
        cv2.imwrite(str(scratch() / f"{number}.png"), image)
    for place, number in enumerate(order):
        (folder / f"{place:06d}.png").symlink_to(scratch() / f"{number}.png")
    return str(folder), sequence.boxes[order]


def schedule(cycles: int, seed: int) -> list[str]:
    """Return the names of the faults, drawn from the seed."""
    share = np.array([often for _, often in FAULTS.values()])
    return [str(name) for name in np.random.default_rng(seed).choice(list(FAULTS), cycles, p=share / share.sum())]


def endure(source: str, boxes: dict[str, Box], settings: Settings, faults: list[str], seed: int = 0) -> Ordeal:
    """Track a source to its end with some faults; progress is printed to stderr.

    If there are several objects, one is forgotten or begins before every other fault.

    Faults of a full disk need a small file system; they are left out if it cannot be mounted.

    Raises
    ------
    ServiceError
        If the pipeline does not reach its end, or the source is too short for all faults.
    """
    random, recovery, changes = np.random.default_rng(seed), defaultdict(list), list[Change]()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="catstream-arena-")))
        if FULL in faults:
            try:
                stack.enter_context(small_disk(folder / "state", len(boxes)))
            except OSError as error:
                print(f"without full disks: {error}", file=sys.stderr)
                faults = [name for name in faults if name != FULL]
        with open_source(source) as video:
            frames = video.frames or 0
        arena = stack.enter_context(Arena(source, boxes, settings, folder / "state", folder))
        arena.calm_from = frames - LAST
        for number, name in enumerate(faults, start=1):
            further(arena, int(random.integers(*CALM)))
            if len(arena.tracks) > frames - LAST:
                raise ServiceError(f"the video ends before fault {number} of {len(faults)}: use a longer one")
            if len(boxes) > 1 and number % 2:
                changes += change(arena, boxes, random)
            arena.taught()
            FAULTS[name][0](arena, random)
            begin = monotonic()
            further(arena, 2)
            if "trainer" in name:
                arena.until(arena.taught)
            recovery[name].append(monotonic() - begin)
            print(f"{number} of {len(faults)}: {name}, {recovery[name][-1]:.2f} s", file=sys.stderr, flush=True)
        arena.finish()
        return Ordeal(
            dict(recovery),
            arena.tracks,
            arena.frames,
            dict(arena.end.totals),
            arena.deaths,
            learned(folder / "state", settings),
            arena.rows_due(),
            changes,
        )


def change(arena: Arena, boxes: dict[str, Box], random: np.random.Generator) -> Iterator[Change]:
    """Forget an object other than the first one, or let it begin again, in its box of the first frame."""
    name = str(random.choice([name for name in boxes if name != FIRST]))
    if name in arena.tracks[-1] and random.random() < FORGET:
        answer = arena.command(lambda control: control.forget(name))
        yield from [] if answer is None else [Change(answer.frame + 1, name, None)]
    else:
        answer = arena.command(lambda control: control.set_box(boxes[name], name))
        yield from [] if answer is None else [Change(answer.frame, name, boxes[name])]


def learned(state: Path, settings: Settings) -> Forest:
    """Load the newest checkpoint in a folder. Raises ValueError if there is none yet."""
    return Forest.load(max(state.rglob("*.safetensors"), key=lambda file: file.stat().st_mtime_ns), settings)


def further(arena: Arena, frames: int) -> None:
    """Wait until a number of further frames were tracked."""
    goal = len(arena.tracks) + frames
    arena.until(lambda: len(arena.tracks) >= goal)


def undisturbed(
    source: str, boxes: dict[str, Box], changes: Collection[Change] = ()
) -> tuple[list[dict[str, Track]], Forest]:
    """Return the tracks and the forest of a run in one process, with the same changes of the objects."""
    tracker, tracks = MultiTracker(), []
    with open_source(source) as frames:
        for frame in frames:
            now = {each.name: each.box for each in changes if each.frame == frame.number}
            for name in (name for name, box in now.items() if box is None):
                tracker.forget(name)
            if tracks:
                begun = {name: box for name, box in now.items() if box is not None}
                tracker.update(frame.image, time=frame.time, begin=begun or None)
            else:
                tracker.init(frame.image, boxes, frame.time)
            tracks.append(tracker.tracks)
    return tracks, tracker.forest


def identical(run: Ordeal, calm: tuple[list[dict[str, Track]], Forest]) -> bool:
    """Return whether two runs gave the same tracks, and the same trees bit for bit."""
    return run.tracks == calm[0] and fingerprint(run.learned) == fingerprint(calm[1])


def found(tracks: list[dict[str, Track]], name: str) -> np.ndarray:
    """Return the boxes of an object, one row for each frame, NaN if it is absent."""
    return np.array([each[name].box or (np.nan,) * 4 for each in tracks])


def fingerprint(forest: Forest) -> dict[str, list[tuple[object, object]]]:
    """Return the content of the trees of each object as bytes."""
    return {
        name: [
            (metadata, {key: (array.shape, array.tobytes()) for key, array in own.items()})
            for own, metadata in (tree.state() for tree in compressor.trees.values())
        ]
        for name, compressor in forest.compressors.items()
    }


def quantiles(recovery: dict[str, list[float]]) -> Iterator[tuple[str, int, float, float, float]]:
    """Return a row for each kind of fault, and one for all."""
    everything = [seconds for times in recovery.values() for seconds in times]
    for name, times in [*sorted(recovery.items()), ("all", everything)]:
        yield name, len(times), *map(float, np.quantile(times, [0.5, 0.99, 1]))


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument("--run", choices=list(RUNS), help="only this one of the two runs")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the small disk is unmounted
    benchmark(
        figures,
        parser,
        cycles=(200, "number of faults"),
        objects=(1, "number of objects"),
        seed=(0, "seed of the schedule"),
    )

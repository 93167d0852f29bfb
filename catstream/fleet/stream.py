"""A stream of a fleet: one pipeline on this node, its state in the store, and the figures that the controller asks for.

A `Stream` has nothing of Ray in it; `catstream.fleet.controller` makes an actor of it. Its pipeline runs in a thread of
its own, and is started again after a failure. Its state is stored by another thread, which also looks for merged models
in the store, so that a slow store does not stop the tracks.
"""

from __future__ import annotations

import logging
import math
import os
import random
import shutil
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Literal, NamedTuple

from catstream.client.control import control
from catstream.errors import (
    CatstreamError,
    CommandRejectedError,
    FencedError,
    FleetError,
    ServiceError,
    StoreError,
)
from catstream.fleet.life import Order
from catstream.fleet.spec import StreamSpec
from catstream.fleet.store import Claim, Generation, Store
from catstream.fleet.timing import (
    BEGIN_SECONDS,
    FIRST_PAUSE_SECONDS,
    FORGOTTEN_SECONDS,
    LONGEST_PAUSE_SECONDS,
    RATE_SECONDS,
    TRACKS_SECONDS,
)
from catstream.messages.kinds import StreamState, StreamStatus, Track
from catstream.messages.storage import Metadata
from catstream.pipeline import Pipeline
from catstream.run.learned import Learned
from catstream.run.state import files, restore, skip
from catstream.video.frames import without_password
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import private_folder
from catstream.wire.keys import Client, ensure, public_key, synchronise

_LATE = 3.0  # a state that is older than so many intervals is a trouble
_SKIPPED_SHARE = 0.1  # of the frames of a live source, from which its node counts as too slow
_LOG_LINES = 1000
_PORTS = range(21000, 32000)  # below those that the kernel gives to connections
#: What a pipeline reports if no frames are tracked, as the state of a stream.
_HOLDING: dict[str, StreamState] = {"waiting": "waiting", "paused": "paused"}
_TICKS = os.sysconf("SC_CLK_TCK")
_TIMES = slice(14, 16)  # fields of /proc/PID/stat: in the program, and in the kernel for it

#: Why a stream has ended with a state, which is its last one: "" for a state that is not.
_End = Literal["", "ended", "moved", "stopped"]

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)  # `catstream fleet logs` shows when a stream was claimed, and when it tracked again


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a stream.

    node     its node, as the status shows it
    address  IP address at which other machines reach its sockets; empty if all clients are on this machine
    clients  the clients that may connect, by name, if there is an address
    """

    node: str
    address: str = ""
    clients: dict[str, Client] = field(default_factory=dict)


class Report(NamedTuple):
    """A report of a stream to the controller.

    status      its figures
    order       what it was started for
    superseded  whether it ended because another process has claimed it
    """

    status: StreamStatus
    order: Order
    superseded: bool = False


@dataclass(slots=True)
class _Rates:
    """Frames, processor time and skipped frames over the last seconds.

    rate     tracked frames a second
    cores    processor cores in use
    skipping share of the frames that were skipped
    """

    since: float = field(default_factory=time.monotonic)
    frames: int = 0
    processor: float = 0.0  # seconds, at the start of the interval
    skipped: int = 0  # frames, at the start of the interval
    rate: float = 0.0
    cores: float = 0.0
    skipping: float = 0.0

    def update(self, processor: Callable[[], float], skipped: int) -> None:
        """Compute the rates if the interval is over."""
        passed = time.monotonic() - self.since
        if passed < RATE_SECONDS:
            return
        used, missed = processor(), max(0, skipped - self.skipped)
        self.rate = self.frames / passed
        self.cores = max(0.0, used - self.processor) / passed
        self.skipping = missed / max(1, missed + self.frames)
        self.since, self.frames, self.processor, self.skipped = time.monotonic(), 0, used, skipped

    @property
    def trouble(self) -> str:
        """What is wrong if too many frames are skipped."""
        if self.skipping <= _SKIPPED_SHARE:
            return ""
        return f"it skips {self.skipping:.0%} of its frames with {self.cores:.1f} cores: give it more, or a faster node"


def given_model(stream: str, name: str) -> str:
    """The name in the store of a saved model that the spec of a stream gives for an object."""
    return f"given.{sha256(f'{stream}/{name}'.encode()).hexdigest()[:32]}"


class Stream:
    """Runs the pipeline of one stream until it ends or is stopped, and stores its state again and again.

    Parameters
    ----------
    spec : the stream
    order : what it is started for, which its reports contain
    place : where it runs
    store : the store of the fleet
    every : seconds between two states in the store
    """

    def __init__(self, spec: StreamSpec, order: Order, place: Place, store: str, every: float) -> None:
        self._spec, self._order, self._place = spec, order, place
        self._url, self._every = store, every
        self._store: Store
        self._status = StreamStatus(spec.name, "starting", place.node, source=without_password(spec.source))
        self._rates = _Rates()
        self._stop, self._lock = threading.Event(), threading.Lock()
        self._lines: deque[str] = deque(maxlen=_LOG_LINES)
        self._stored_at = 0.0  # seconds since 1970
        self._began_at = 0.0  # the same, of the pipeline
        self._planned = 0  # starts of the stream that followed no failure
        self._end: _End = ""
        self._failure = self._store_trouble = self._pipeline_trouble = ""
        self._superseded = False
        self._seq = 0
        self._follow: tuple[str, ...] = spec.follow
        self._present: set[str] = set()  # objects that the last frame shows
        self._stack = ExitStack()
        self._folder = self._stack.enter_context(private_folder())
        self._keys = self._folder / "keys"
        self._thread = threading.Thread(target=self._run, name=f"stream {spec.name}", daemon=True)
        self._thread.start()

    def report(self, clients: dict[str, Client] | None = None, follow: Iterable[str] | None = None) -> Report:
        """The figures of the stream now.

        Parameters
        ----------
        clients : the only clients that may connect from now on
        follow : the objects whose newest merged model it searches for from now on
        """
        with self._lock:
            if clients is not None and clients != self._place.clients:
                self._place = replace(self._place, clients=clients)
                if self._place.address and self._keys.exists():
                    synchronise(self._keys, clients)
            self._follow = self._follow if follow is None else tuple(follow)
            age = time.time() - self._stored_at if self._stored_at else 0.0
            is_late = min(age, time.time() - self._began_at) > _LATE * self._every and not self._store_trouble
            late = f"its state was stored {age:.0f} s ago" if is_late and self._status.state == "running" else ""
            troubles = (self._failure, self._store_trouble, late, self._rates.trouble, self._pipeline_trouble)
            status = replace(
                self._status,
                rate=self._rates.rate,
                cores=self._rates.cores,
                stored_seconds=age if self._stored_at else None,
                trouble="; ".join(filter(None, troubles)),
            )
            return Report(status, self._order, self._superseded)

    def logs(self, lines: int) -> list[str]:
        """The last lines that the stream logged."""
        return list(self._lines)[-lines:]

    def stop(self, end: _End = "stopped") -> str:
        """End the pipeline, and store its last state; returns why it could not be stored, or nothing.

        Parameters
        ----------
        end : why, for the one that continues it
        """
        self._end = end
        self._stop.set()
        self._thread.join()
        self._stack.close()
        return self._store_trouble

    def _run(self) -> None:
        """Run the pipeline, again after each failure, until the stream ends, is stopped, or is superseded."""
        handler = _Lines(self._lines)
        logging.getLogger("catstream").addHandler(handler)
        pause = FIRST_PAUSE_SECONDS
        try:
            while not self._stop.is_set():
                began = time.monotonic()
                try:
                    return self._run_once()
                except StoreError as error:  # the claim: nothing has begun
                    self._store_trouble = str(error)
                except Exception as error:  # the controller has to see it
                    if not isinstance(error, CatstreamError):
                        _log.exception("The stream %s failed.", self._spec.name)
                    self._fail(str(error) if isinstance(error, CatstreamError) else f"{type(error).__name__}: {error}")
                pause = FIRST_PAUSE_SECONDS if time.monotonic() - began > FORGOTTEN_SECONDS else pause
                self._stop.wait(pause)
                pause = min(2 * pause, LONGEST_PAUSE_SECONDS)
        finally:
            logging.getLogger("catstream").removeHandler(handler)

    def _fail(self, why: str) -> None:
        _log.error("%s: %s", self._spec.name, why)
        with self._lock:
            self._failure, self._pipeline_trouble = why, ""
            self._status = replace(self._status, state="failed", endpoint="", rate=0.0)

    def _run_once(self) -> None:
        """Claim the stream, and run the pipeline from the state in the store, or from the start."""
        self._store = Store(self._url)
        claim = self._store.stream(self._spec.name).claim(f"{self._place.node} process {os.getpid()}")
        self._store_trouble = ""
        where = f"after frame {claim.state.facts['frame']}" if claim.state is not None else "from the start"
        _log.info("%s: claimed with token %d, %s", self._spec.name, claim.token, where)
        shutil.rmtree(self._folder / "state", ignore_errors=True)  # of the run before a failure
        self._seq = 0
        facts: Metadata = claim.state.facts if claim.state is not None else {}
        self._planned = facts["planned"] + bool(facts["end"]) if facts else claim.removed + 1
        with self._lock:
            self._status = replace(self._status, restarts=claim.token - self._planned)
        if claim.state is not None and facts["end"] == "ended":
            if facts["digest"] == self._spec.digest:
                restarts = claim.state.token - facts["planned"]  # this claim only finds that it has ended
                with self._lock:
                    self._stored_at = float(facts["time"])
                    self._status = replace(self._status, state="ended", frame=int(facts["frame"]), restarts=restarts)
                return
            claim.state, facts = None, {}  # it was changed since: it begins again
        # Token of the pipeline with which frames began to count from 0; 0 if it was the first one of the stream.
        began = int(facts["began"]) if facts else claim.token if claim.token > 1 else 0
        with ExitStack() as stack:
            pipeline = stack.enter_context(self._made(claim))
            with self._lock:
                self._failure = ""
                self._began_at, self._stored_at = time.time(), float(facts.get("time", 0.0))
                self._status = replace(
                    self._status,
                    state="starting",
                    endpoint=pipeline.endpoint,
                    server=public_key(self._keys) if self._place.address else "",
                    token=claim.token,
                    began=began,
                    lost_frames=int(facts.get("lost_frames", 0)),
                    lost_seconds=float(facts.get("lost_seconds", 0.0)),
                )
            self._change_objects(pipeline, facts)
            _log.info("%s: its processes have started", self._spec.name)
            over = threading.Event()
            storing = threading.Thread(target=self._keep_storing, args=(claim, pipeline, over), name="store")
            storing.daemon = True  # a store that hangs must not keep the process
            storing.start()
            stack.callback(storing.join)
            stack.callback(over.set)
            ended = self._take_all(pipeline)
        self._write_last(claim, ended=ended)

    def _take_all(self, pipeline: Pipeline) -> bool:
        """Take the tracks until the source ends, or the stream is to stop; returns whether the source has ended."""
        for tracks in pipeline.by_frame(TRACKS_SECONDS):
            self._take(pipeline, tracks)
            if self._stop.is_set():
                return False
        return True

    def _write_last(self, claim: Claim, *, ended: bool) -> None:
        """Store the last state. A stream has ended once that is done, so it is tried again until it is."""
        while not self._superseded:
            self._write(claim, "ended" if ended else self._end)
            if not self._store_trouble:
                with self._lock:
                    self._status = replace(self._status, state="ended" if ended else self._status.state)
                return
            if not ended or self._stop.wait(self._every):
                return

    def _made(self, claim: Claim) -> Pipeline:
        """The pipeline, which continues from the state of the claim if there is one."""
        settings = self._spec.settings | self._sockets()
        state = self._folder / "state"
        if claim.state is None:
            boxes = self._spec.boxes or None
            return Pipeline(self._spec.source, boxes, settings, state=state)
        restore(state, claim.state.files)
        pipeline = Pipeline(self._spec.source, settings=settings, resume=state)
        if pipeline.live and claim.state.facts["end"] != "stopped":
            self._count_lost(pipeline, state, claim.state.facts)
        return pipeline

    def _count_lost(self, pipeline: Pipeline, state: Path, facts: Metadata) -> None:
        """Count the frames of a live source since the last state as lost: their numbers are not used again."""
        seconds = max(0.0, time.time() - facts["time"]) + BEGIN_SECONDS
        frames = math.ceil(seconds * max(pipeline.rate, facts["rate"]))
        lost = skip(state, pipeline.settings, facts["seq"], frames)
        if facts["holds"]:
            return
        facts["lost_frames"] += lost
        facts["lost_seconds"] += seconds
        _log.warning("%s: %d frames in %.1f s were lost", self._spec.name, lost, seconds)

    def _sockets(self) -> dict[str, object]:
        """The settings of the sockets: those of a private folder, or ports of this node with keys made here."""
        if not self._place.address:
            return {"run.endpoint": "", "run.keys": ""}
        with self._lock:
            ensure(self._keys)
            synchronise(self._keys, self._place.clients)
        endpoint = f"tcp://{self._place.address}:{_free_port(self._place.address)}"
        return {"run.endpoint": endpoint, "run.keys": str(self._keys)}

    def _change_objects(self, pipeline: Pipeline, facts: Metadata) -> None:
        """Begin the objects that the spec has now and had not when the state was made, and forget the others."""
        before = set(facts["objects"]) if facts else set(self._spec.boxes)
        now = self._spec.boxes.keys() | self._spec.models.keys()
        begin, forget = sorted(self._spec.boxes.keys() - before), sorted(before - now)
        if begin or forget:  # a peer that connects for nothing counts as rejected
            with control(pipeline.endpoint, keys=pipeline.settings.run.keys) as controlled:
                for name in begin:
                    controlled.set_box(self._spec.boxes[name], name)
                for name in forget:
                    with suppress(CommandRejectedError):  # it was forgotten already
                        controlled.forget(name)
        for name in sorted(self._spec.models.keys() - before):
            if (model := self._store.model(given_model(self._spec.name, name)).newest()) is None:
                raise FleetError(f"{self._spec.name} has no saved model of {name!r} in the store: apply the file again")
            self._search(pipeline, model, name)

    def _search(self, pipeline: Pipeline, model: Generation, name: str) -> None:
        """Search for an object by a saved model in the store."""
        learned = Learned.from_bytes(model.files["model"], f"the model of {name!r} in the store")
        with control(pipeline.endpoint, keys=pipeline.settings.run.keys) as controlled:
            controlled.search(learned, name)

    def _search_merged(self, pipeline: Pipeline, known: dict[str, int]) -> None:
        """Search for each followed object that is not present by a merged model that is newer than the known one."""
        for name in self._follow:
            if name in self._present:
                continue
            if (model := self._store.model(name).newest(known.get(name, 0))) is not None:
                known[name] = model.token
                self._search(pipeline, model, name)

    def _take(self, pipeline: Pipeline, tracks: dict[str, Track]) -> None:
        """Count a frame; an empty mapping means that none has arrived for a while."""
        skipped = int(pipeline.health.get("detector", {}).get("skipped", 0))
        troubles = [f"{process}: {trouble}" for process, trouble in pipeline.trouble.items()]
        if pipeline.lost_seconds:
            troubles.append(f"its source has been lost for {pipeline.lost_seconds:.0f} s")
        self._rates.update(lambda: _processor_seconds([os.getpid(), *pipeline.pids.values()]), skipped)
        if pipeline.holding:  # on purpose
            self._rates.skipped, self._rates.skipping = skipped, 0.0
        with self._lock:
            status = self._status
            if tracks:
                if not self._seq:  # the seconds of the start do not count
                    self._rates = _Rates(skipped=skipped)
                    _log.info("%s: the first frame is tracked", self._spec.name)
                self._rates.frames += 1
                newest = next(iter(tracks.values()))
                models = {name: track.model_version for name, track in tracks.items()}
                self._seq = newest.seq
                self._present = {name for name, track in tracks.items() if track.box is not None}
                status = replace(status, frame=newest.frame, models=models)
            state = _HOLDING.get(pipeline.holding, "running" if self._seq else "starting")
            self._status = replace(status, state=state, skipped=skipped)
            self._pipeline_trouble = "; ".join(troubles)

    def _keep_storing(self, claim: Claim, pipeline: Pipeline, over: threading.Event) -> None:
        """Store the state every few seconds until the pipeline is over, or another process has claimed the stream."""
        known: dict[str, int] = {}  # token of the merged model of each object that was searched for
        while not over.wait(self._every) and not self._superseded:
            self._write(claim)
            try:
                self._search_merged(pipeline, known)
            except CatstreamError as error:
                _log.warning("%s does not search by a merged model: %s", self._spec.name, error)

    def _write(self, claim: Claim, end: _End = "") -> None:
        """Store the newest checkpoint. A failed write is reported in the status; a superseded claim ends the stream."""
        status, seq = self._status, self._seq
        facts: Metadata = {
            "time": time.time(),
            "seq": seq,
            "frame": status.frame,
            "rate": self._rates.rate,
            "began": status.began,
            "lost_frames": status.lost_frames,
            "lost_seconds": status.lost_seconds,
            "objects": sorted(self._spec.boxes.keys() | self._spec.models.keys()),
            "digest": self._spec.digest,
            "planned": self._planned,
            "holds": status.state in _HOLDING.values(),  # so that it tracks no frame
            "end": end,
        }
        trouble = ""
        try:
            if content := files(self._folder / "state"):
                claim.write(content, facts)
                self._stored_at = facts["time"]
        except FencedError as error:
            _log.warning("%s: %s", self._spec.name, error)
            self._superseded = True
            self._stop.set()
        except (ServiceError, OSError) as error:
            trouble = f"its state cannot be stored: {error}"
        with self._lock:
            self._store_trouble = trouble


class _Lines(logging.Handler):
    """Keeps log records as lines of text."""

    def __init__(self, lines: deque[str]) -> None:
        super().__init__(logging.INFO)
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        moment = time.strftime("%H:%M:%S", time.localtime(record.created))
        self._lines.append(f"{moment}.{int(record.msecs):03d} {record.levelname.lower()} {record.getMessage()}")


def _processor_seconds(pids: list[int]) -> float:
    """Processor time of processes so far, in seconds."""
    seconds = 0.0
    for pid in pids:
        with suppress(OSError):  # it has ended
            fields = ["", "", "", *Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()]
            seconds += sum(map(int, fields[_TIMES])) / _TICKS
    return seconds


def _free_port(address: str) -> int:
    """A port of this node after which the ports of all channels are free."""
    count = max(channel.port + len(channel.senders) for channel in CHANNELS.values())
    while True:
        first = random.choice(_PORTS)
        with ExitStack() as stack, suppress(OSError):
            for port in range(first, first + count):
                stack.enter_context(socket.socket()).bind((address, port))
            return first

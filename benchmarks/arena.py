"""A pipeline with injectable faults of processes, links, disk and clock; each process has its own loopback address.

Each of the three processes runs as if on a host of its own: 127.0.0.1, .2 and .3. They are connected by links, TCP
proxies that can be cut and slowed. A process that dies is restarted at once, as systemd or docker does; the arena
itself is the owner of the run, which receives every track.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Self
from unittest.mock import patch

from catstream.box import Box
from catstream.client.control import Control, control
from catstream.errors import ServiceError
from catstream.messages.kinds import Answer, End, Track, Tracks
from catstream.run.job import Job
from catstream.services.process import PERMANENT_FAILURE
from catstream.services.start_server import NAMES, close_start_server, start_server
from catstream.services.supervisor import Child
from catstream.settings import Settings
from catstream.wire.channels import CHANNELS, MODELS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber
from catstream.wire.results import ResultsReceiver

#: Address of each process; the consumer of the tracks has that of the detector.
HOSTS = {"compressor": "127.0.0.1", "trainer": "127.0.0.2", "detector": "127.0.0.3"}

#: Channel -> (process that listens, process that connects).
LINKS = {
    "features": ("compressor", "detector"),
    "samples": ("compressor", "trainer"),
    "models": ("trainer", "detector"),
}

_PATIENCE_SECONDS = 120.0  # the run counts as stuck after this time without a track
_DISK = 128  # megabytes of the small disk for each object: three checkpoints, as the oldest of them is removed last
#: The module `sitecustomize` of each process. It shifts the wall clock by the seconds in a file; monotonic clocks are
#: unchanged, as they are if an administrator or NTP sets the clock. And it writes down how many rows of each message
#: belong into the trees of each object, counted without the trees: `Arena.rows_due` adds them up.
_MODULE = """
import json, os, time
from catstream.numerics.threads import limit_process
limit_process()  # before anything imports numpy
from catstream.compression.forest import Forest
from catstream.messages.heads import TREES
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


class Link:
    """A TCP proxy, in a thread of its own.

    Parameters
    ----------
    listen, forward : host and port
    """

    def __init__(self, listen: tuple[str, int], forward: tuple[str, int]) -> None:
        self._forward, self._delay, self._up = forward, 0.0, True
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._socket = socket.create_server(listen)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port on which it listens."""
        port: int = self._socket.getsockname()[1]
        return port

    def cut(self) -> None:
        """Break all connections, and accept none until `mend`."""
        self._up = False
        self._loop.call_soon_threadsafe(self._break)

    def slow(self, seconds: float) -> None:
        """Delay each piece of up to 64 KiB by this time."""
        self._delay = seconds

    def mend(self) -> None:
        """Forward everything without delay."""
        self._up, self._delay = True, 0.0

    def close(self) -> None:
        """Break all connections, and stop listening."""
        self.cut()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        self._loop.run_until_complete(asyncio.start_server(self._serve, sock=self._socket))
        self._loop.run_forever()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.run_until_complete(asyncio.sleep(0.01))
        self._loop.close()

    def _break(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers = {writer}
        try:
            if self._up:
                other, forth = await asyncio.open_connection(*self._forward)
                writers.add(forth)
                self._writers |= writers
                await asyncio.gather(self._pass(reader, forth), self._pass(other, writer))
        except OSError:  # nothing listens there, or one side has disconnected
            pass
        finally:
            for one in writers:
                one.transport.abort()
            self._writers -= writers

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65536):
            if self._delay:
                await asyncio.sleep(self._delay)
            writer.write(data)
            await writer.drain()
        raise ConnectionResetError


class Arena:
    """One run of a pipeline; open it, and call `turn` until `end` is set.

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
    links : link of each channel
    """

    def __init__(self, source: str, boxes: dict[str, Box], settings: Settings, state: Path, scratch: Path) -> None:
        self.state, self.tracks, self.frames, self.deaths = state, list[dict[str, Track]](), list[int](), 0
        self.end: End | None = None
        self._settings, self._source, self._boxes, self._folder = settings, source, boxes, scratch
        self._children: dict[str, Child] = {}
        self._places: dict[str, Endpoint] = {}
        self._last_received = monotonic()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            port = _free_port()
            self._places = {name: Endpoint.parse(f"tcp://{host}:{port}") for name, host in HOSTS.items()}
            self.links = {
                name: Link((HOSTS[by], port + CHANNELS[name].port), (HOSTS[to], port + CHANNELS[name].port))
                for name, (to, by) in LINKS.items()
            }
            for link in self.links.values():
                stack.callback(link.close)
            (self._folder / "sitecustomize.py").write_text(_MODULE)
            window = self._settings.run.unstored_frames + 1
            self._results = stack.enter_context(ResultsReceiver(self._places["detector"], window, 0))
            self._models = stack.enter_context(Subscriber(MODELS, self._places["trainer"]))
            self._control = stack.enter_context(control(str(self._places["detector"]), timeout=_PATIENCE_SECONDS))
            self._pool = stack.enter_context(ThreadPoolExecutor(1))
            path = os.pathsep.join([str(self._folder), *filter(None, [os.environ.get("PYTHONPATH")])])
            close_start_server()  # the next one has these variables
            stack.callback(close_start_server)
            stack.enter_context(patch.dict(os.environ, {"PYTHONPATH": path, "ARENA": str(self._folder)}))
            for name in NAMES:
                self._children[name] = Child(name, self._job(name), self._folder)
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
            self._children["detector"].watchdog.read = math.inf if self.end is not None else message.seq
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
        """Call `turn` for some seconds."""
        over = monotonic() + seconds
        self.until(lambda: monotonic() >= over)

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

    def _job(self, name: str) -> Path:
        """The file of the job of a process: each meets the others at a link of its own."""
        folder = self._folder / f"job-{name}"
        folder.mkdir(exist_ok=True)
        job = Job(self._source, self._boxes, settings=self._settings, owned=True, resume=True)
        state = self.state if name == "compressor" else folder
        return replace(job, state=state, endpoint=str(self._places[name])).save(folder)


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


def _free_port() -> int:
    """Return the first of enough consecutive ports that are free on all hosts."""
    span = max(channel.port + len(channel.senders) for channel in CHANNELS.values())
    for first in range(21000 + os.getpid() % 500 * 20, 32000, span):
        with ExitStack() as stack, suppress(OSError):
            for host in HOSTS.values():
                for port in range(first, first + span):
                    stack.enter_context(socket.socket()).bind((host, port))
            return first
    raise ServiceError("there are not enough consecutive free ports on this machine")

"""Keeps the head or a node of a cluster running: starts Ray, and starts it again after its death.

A keeper is the process of `catstream fleet head` or `catstream fleet node`. It holds the lock of the file NAME.pid, in
which its process id is, and ends all of its processes on SIGTERM.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import re
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from catstream.errors import FleetError, UnreachableError
from catstream.extras import require_extra
from catstream.fleet import cluster
from catstream.storage import is_locked, lock
from catstream.wire.endpoint import private_folder
from catstream.wire.keys import create

__all__ = ["PORTS", "holder", "keep_head", "keep_node"]

#: Number of ports that a node uses if its first port is given.
PORTS = 100

#: Port of the registry, by default.
REGISTRY_PORT = 5690

_OBJECT_STORE_BYTES = 80_000_000  # the least that Ray accepts with some room: messages of a fleet are small
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 30.0
_HEALTHY_SECONDS = 60.0  # Ray ran for so long: its next death is a new one, and the pause is short again
_END_SECONDS = 10.0  # for Ray to end its processes before they are killed
_LOOK_SECONDS = 0.2
_STARTED = "Ray runtime started."
_DEATHS = "Some Ray subprocesses exited unexpectedly"  # before a report of many lines
_DIED = re.compile(r"\w+ \[exit code=-?\d+\]")
_LINE = re.compile(r"\S+ \S+\t(?P<level>[A-Z]+) \S+ -- (?P<text>.*)")  # of `ray start --log-style record`
_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?")

_log = logging.getLogger(__name__)


def keep_head(listen: str, folder: Path, ports: int = 0, registry: int = REGISTRY_PORT) -> None:
    """Run the head of a cluster until SIGTERM or SIGINT.

    Parameters
    ----------
    listen : IP:PORT, a private address of this machine
    folder : for the token, which is made if there is none, and for the state of the cluster
    ports : first of the `PORTS` ports of its processes; 0 for any that are free
    registry : port of the registry

    Raises
    ------
    FleetError
        If the address is not private, or another process is the head of this folder.
    """
    require_extra("fleet")
    host, port = cluster.private_address(listen)
    token, state = folder / "token", folder / "gcs"
    cluster.make_token(token)
    cluster.read_token(token)
    state.mkdir(mode=0o700, exist_ok=True)
    if not (folder / "keys").exists():
        create(folder / "keys")
    own = {cluster.FOLDER_VARIABLE: str(folder.absolute()), cluster.REGISTRY_VARIABLE: f"tcp://{host}:{registry}"}
    arguments = [
        *("--head", "--port", str(port), "--include-dashboard", "false", "--no-monitor", "--disable-usage-stats"),
        *("--resources", json.dumps({cluster.HEAD_RESOURCE: 1})),
        *_arguments("head", host, 0, ports),
    ]
    with _alone("head", folder):
        _Keeper(
            f"the head of the fleet at {listen}",
            arguments,
            _labels("head", 0, {}),
            cluster.child_environment(token, state) | own,
            f"the head listens at {listen}; a node joins with a copy of {token.absolute()}: "
            f"catstream fleet node --head {listen} --token-file token --name NAME",
        ).run(_ended())


def keep_node(
    head: str, token_file: Path, folder: Path, name: str, cores: float | None, labels: dict[str, str], ports: int = 0
) -> None:
    """Run a node of a cluster until SIGTERM or SIGINT; it waits for a head that does not answer.

    Parameters
    ----------
    head : IP:PORT of the head
    token_file : file with the token of the fleet
    folder : for the file with the process id of this keeper
    name : of the node
    cores : processor cores for streams; None for all of this machine
    labels : by which streams choose nodes
    ports : first of the `PORTS` ports of its processes; 0 for any that are free

    Raises
    ------
    FleetError
        If the head's address or the address of this machine is not private, the token is refused, the cluster asks for
        none, or a label or the name is not valid.
    """
    require_extra("fleet")
    host, port = cluster.private_address(head)
    cluster.read_token(token_file)
    _check_labels(name, labels)
    cores = float(len(os.sched_getaffinity(0))) if cores is None else cores
    own, _ = cluster.private_address(f"{_own_address(host, port)}:{port}")
    arguments = ["--address", head, *_arguments(name, own, cores, ports)]
    with _alone(name, folder):
        _Keeper(
            f"node {name}",
            arguments,
            _labels(name, cores, labels),
            cluster.child_environment(token_file),
            f"node {name} has joined the fleet at {head}: {own}, {cores:g} cores",
            lambda: _check_head(name, head, token_file),
        ).run(_ended())


def holder(name: str, folder: Path) -> int | None:
    """Return the process id of the keeper that runs a node, or the node `head`, in a folder; None if there is none."""
    with contextlib.suppress(OSError, ValueError), (folder / f"{name}.pid").open() as file:
        return int(file.read()) if is_locked(file.fileno()) else None
    return None


def _arguments(name: str, host: str, cores: float, ports: int) -> list[str]:
    """The arguments of `ray start` that the head and a node have in common."""
    return [
        *("--node-ip-address", host, "--node-name", name, "--num-cpus", str(math.ceil(cores))),
        *("--object-store-memory", str(_OBJECT_STORE_BYTES), "--include-log-monitor", "false"),
        *_ports(ports),
    ]


def _labels(name: str, cores: float, labels: dict[str, str]) -> dict[str, str]:
    """The labels of a node: the user's, its name, its cores, and its versions."""
    facts = {"node": name, "cores": f"{cores:g}", **cluster.versions()}
    return labels | {f"{cluster.PREFIX}{key}": cluster.label_value(value) for key, value in facts.items()}


def _ports(first: int) -> list[str]:
    """The arguments of `ray start` for fixed ports, so that a firewall can name them."""
    if not first:
        return []
    names = "node-manager", "object-manager", "runtime-env-agent"
    single = [word for i, name in enumerate(names) for word in (f"--{name}-port", str(first + i))]
    return [*single, "--min-worker-port", str(first + len(names)), "--max-worker-port", str(first + PORTS - 1)]


def _check_labels(name: str, labels: dict[str, str]) -> None:
    for what, text in (("name", name), *(("label", part) for pair in labels.items() for part in pair)):
        if not _LABEL.fullmatch(text):
            raise FleetError(
                f"node {name!r}: a {what} is 1 to 63 letters, digits, dots, dashes and underscores, got {text!r}"
            )


def _own_address(host: str, port: int) -> str:
    """The address of this machine from which it reaches another one. Nothing is sent."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((host, port))
            address: str = probe.getsockname()[0]
            return address
    except OSError as error:
        raise FleetError(f"no network of this machine leads to the head at {host}:{port} ({error.strerror})") from None


def _check_head(name: str, head: str, token_file: Path) -> str:
    """Why the head cannot be joined now, empty if it can; raises a FleetError if waiting would not help."""
    try:
        cluster.private_address(head)
        cluster.probe(head, token_file)
    except UnreachableError as error:
        return f"node {name} waits: {error}"
    return ""


@contextlib.contextmanager
def _alone(name: str, folder: Path) -> Iterator[None]:
    """Hold the lock of NAME.pid, with the process id in it."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / f"{name}.pid"
    with path.open("a+") as file:
        if not lock(file.fileno()):
            raise FleetError(f"{name} runs already, as process {holder(name, folder)}: its lock is {path}")
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


@dataclass
class _Keeper:
    """Runs `ray start` until an event is set, and starts it again after its death.

    title      of what it runs, for its messages
    arguments  of `ray start`
    labels     of the node
    variables  the environment of its processes
    started    message of each start
    check      called before each start: a reason to wait, or empty
    """

    title: str
    arguments: list[str]
    labels: dict[str, str]
    variables: dict[str, str]
    started: str
    check: Callable[[], str] = str
    cause: str = field(default="", init=False)  # of the last death
    dying: bool = field(default=False, init=False)  # Ray reports the death of one of its processes

    def run(self, ended: threading.Event) -> None:
        """Run until the event is set."""
        pause = _FIRST_PAUSE
        with private_folder() as folder:
            while not ended.is_set():
                began = time.monotonic()
                trouble = self.check() or self._run_once(folder, ended)
                if time.monotonic() - began > _HEALTHY_SECONDS:
                    pause = _FIRST_PAUSE
                if not ended.is_set():
                    _log.warning("%s; next attempt in %g s", trouble, pause)
                    ended.wait(pause)
                pause = min(2 * pause, _LONGEST_PAUSE)
        _log.info("%s has ended", self.title)

    def _run_once(self, folder: Path, ended: threading.Event) -> str:
        """Run Ray until it ends or the event is set; return how it ended."""
        (folder / "ray_current_cluster").unlink(missing_ok=True)  # of its predecessor: Ray would not start
        self.cause, self.dying = "", False
        labels = self.labels | {f"{cluster.PREFIX}since": str(int(time.time()))}
        reading, writing = os.pipe()
        process = subprocess.Popen(
            [
                *(sys.executable, "-P", "-m", "catstream.fleet.launch", str(os.getpid()), "start", "--block"),
                *("--temp-dir", str(folder), "--log-style", "record", "--log-color", "false", *self.arguments),
                *("--labels", ",".join(map("=".join, labels.items()))),
            ],
            env=self.variables,
            stdin=subprocess.DEVNULL,
            stdout=writing,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for the keeper; what is left of the group is killed at the end
        )
        os.close(writing)
        with process, os.fdopen(reading, "rb"):
            self._forward_lines(reading, lambda: process.poll() is not None or ended.is_set())
            _end(process)
        return f"{self.title} died with {_ending(process.returncode)}: {self.cause or 'it printed nothing'}"

    def _forward_lines(self, handle: int, over: Callable[[], bool]) -> None:
        """Log the lines that matter until all is over; processes of Ray may hold the pipe open for longer."""
        part, finished = b"", False
        with selectors.DefaultSelector() as selector:
            selector.register(handle, selectors.EVENT_READ)
            while True:
                if selector.select(0 if finished else _LOOK_SECONDS) and (data := os.read(handle, 65536)):
                    *lines, part = (part + data).split(b"\n")
                    for line in lines:
                        self._forward(line.decode(errors="replace"))
                elif finished:
                    return
                finished = finished or over()

    def _forward(self, line: str) -> None:
        """Log a line of Ray if it matters; keep the one that says why Ray ends."""
        found = _LINE.fullmatch(line)
        text = found["text"] if found is not None else line.strip()
        if found is not None and _STARTED in text:
            self.cause = ""
            _log.info("%s", self.started)
            _notify("READY=1")
        elif _DIED.fullmatch(text) or (found is None and text and not self.dying):
            self.cause = text
        elif text.startswith(_DEATHS):
            self.dying = True
        elif found is not None and found["level"] not in ("INFO", "SUCC") and not self.dying:
            _log.warning("%s: %s", self.title, text)


def _ended() -> threading.Event:
    """An event that is set by SIGTERM and SIGINT."""
    event = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: event.set())
    return event


def _end(process: subprocess.Popen[bytes]) -> None:
    """End `ray start`, and kill what is left of its process group."""
    process.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_END_SECONDS)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _ending(code: int) -> str:
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _notify(state: str) -> None:
    """Tell the service manager that started this process, if any, how it is (see sd_notify(3))."""
    if address := os.environ.get("NOTIFY_SOCKET"):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.sendto(state.encode(), address.replace("@", "\0", 1) if address[0] == "@" else address)

"""LocalFleet: a cluster on this machine, as background processes that go on when this process ends."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from catstream.errors import FleetError
from catstream.extras import require_extra
from catstream.fleet.keeper import holder
from catstream.services import start
from catstream.storage import write_atomically

__all__ = ["LocalFleet"]

_HOST = "127.0.0.1"
_START_SECONDS = 150.0  # on a machine that is busy
_END_SECONDS = 20.0
_LOOK_SECONDS = 0.05
_MAIN = "from catstream.cli import main; main()"


class LocalFleet:
    """The head and the nodes of a cluster that runs on this machine alone; its ports are on the loopback interface.

    Any process of this user can use it. Each node is a background process (`catstream fleet node`), which starts Ray
    again after its death.

    Parameters
    ----------
    folder : for the token, the state of the cluster, logs and process ids; made if there is none
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()

    @property
    def token_file(self) -> Path:
        """File with the token of the fleet."""
        return self.folder / "token"

    @property
    def running(self) -> bool:
        """Whether the head's background process runs."""
        return holder("head", self.folder) is not None

    @property
    def names(self) -> list[str]:
        """Names of the nodes whose background processes run, without the head."""
        names = (path.stem for path in sorted(self.folder.glob("*.pid")))
        return [name for name in names if name != "head" and holder(name, self.folder) is not None]

    @property
    def address(self) -> str:
        """HOST:PORT of the head.

        Raises
        ------
        FleetError
            If it does not run.
        """
        with contextlib.suppress(OSError):
            if self.running:
                return (self.folder / "address").read_text()
        raise FleetError(f"no fleet of yours runs in {self.folder}: start one (catstream fleet up)")

    def start(self, nodes: int = 1, cores: float | None = None) -> None:
        """Start the head and the nodes node-1, node-2 ... that do not run, and wait until all have started.

        Parameters
        ----------
        nodes : number of nodes
        cores : of each node, for streams; None divides the cores of this machine among them

        Raises
        ------
        FleetError
            If one of them does not start; those that were started by this call are stopped.
        """
        require_extra("fleet")
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.folder.chmod(0o700)
        (self.folder / "logs").mkdir(exist_ok=True)
        cores = round(len(os.sched_getaffinity(0)) / nodes, 2) if cores is None and nodes else cores
        began: dict[str, int] = {}
        try:
            if not self.running:
                address = self._remembered_address()
                self._keep(began, {"head": ["head", "--listen", address, "--folder", str(self.folder)]})
            wanted = [f"node-{number}" for number in range(1, nodes + 1)]
            missing = [name for name in wanted if holder(name, self.folder) is None]
            self._keep(began, {name: self._node(name, cores or 0.0, {}) for name in missing})
        except BaseException:
            self._stop(began)
            self._end_children(began.values())
            raise

    def start_node(self, name: str, cores: float, labels: dict[str, str] | None = None) -> None:
        """Start one more node, and wait until it has joined.

        Raises
        ------
        FleetError
            If it does not start.
        """
        self._keep({}, {name: self._node(name, cores, labels or {})})

    def stop_node(self, name: str) -> None:
        """Stop a node for good."""
        self._stop([name])

    def _node(self, name: str, cores: float, labels: dict[str, str]) -> list[str]:
        options = [word for label in labels.items() for word in ("--label", "=".join(label))]
        place = ["--head", self.address, "--token-file", str(self.token_file), "--folder", str(self.folder)]
        return ["node", *place, "--name", name, "--cores", f"{cores:g}", *options]

    def stop(self) -> None:
        """Stop all nodes, then the head. The token, the state of the cluster and the logs stay."""
        self._stop(self.names)
        self._stop(["head"])

    def _remembered_address(self) -> str:
        """The address of the last start, so that nodes and drivers find the head again; a free port at first."""
        path = self.folder / "address"
        with contextlib.suppress(OSError):
            return path.read_text()
        with socket.create_server((_HOST, 0)) as server:
            address = f"{_HOST}:{server.getsockname()[1]}"
        write_atomically(path, address.encode())
        return address

    def _keep(self, began: dict[str, int], commands: dict[str, list[str]]) -> None:
        """Start background processes by name, and wait until each has reported that Ray runs."""
        waited = set(commands)
        with tempfile.TemporaryDirectory(prefix="catstream-") as folder, contextlib.ExitStack() as stack:
            receivers = {}
            for name, command in commands.items():
                receiver = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
                receiver.bind(f"{folder}/{name}")
                receiver.setblocking(False)
                receivers[name] = receiver
                began[name] = self._spawn(name, command, f"{folder}/{name}")

            def settled() -> bool:
                for name in sorted(waited):
                    with contextlib.suppress(BlockingIOError):
                        receivers[name].recv(100)
                        waited.discard(name)
                return not waited or any(_has_ended(began[name]) for name in waited)

            if not _wait(settled, _START_SECONDS) or waited:
                name = min(waited, key=lambda name: not _has_ended(began[name]))
                raise FleetError(f"{name} does not start: {self._last_line(name)}")

    def _spawn(self, name: str, command: list[str], notified: str) -> int:
        """Start a background process that reports to the socket `notified`; return its process id."""
        log = self.folder / "logs" / f"{name}.log"
        return os.posix_spawn(  # unlike a Popen, it may outlive this process without a warning
            sys.executable,
            [sys.executable, "-P", "-c", _MAIN, "fleet", *command, "--ports", "0"],
            start.environment() | {"NOTIFY_SOCKET": notified},
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                (os.POSIX_SPAWN_OPEN, 1, log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600),
                (os.POSIX_SPAWN_DUP2, 1, 2),
            ],
            setsid=True,
        )

    def _stop(self, names: Iterable[str]) -> None:
        """End the background processes of these names, and wait for them."""
        pids = {name: pid for name in names if (pid := holder(name, self.folder)) is not None}
        for pid in pids.values():
            _signal(pid, signal.SIGTERM)
            _signal(pid, signal.SIGCONT)  # one that was frozen ends, too
        if not _wait(lambda: all(holder(name, self.folder) is None for name in pids), _END_SECONDS):
            for name, pid in pids.items():
                if holder(name, self.folder) == pid:
                    _signal(pid, signal.SIGKILL)  # Ray ends with its keeper

    def _end_children(self, pids: Iterable[int]) -> None:
        """End background processes that were started just now and do not hold their lock yet, and wait for them."""
        left = [pid for pid in pids if not _has_ended(pid)]
        for pid in left:
            _signal(pid, signal.SIGTERM)
        _wait(lambda: all(map(_has_ended, left)), _END_SECONDS)

    def _last_line(self, name: str) -> str:
        lines = (self.folder / "logs" / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1].removeprefix("catstream: ") if lines else "it printed nothing"


def _has_ended(pid: int) -> bool:
    """Whether a child of this process has ended."""
    try:
        return os.waitpid(pid, os.WNOHANG) != (0, 0)
    except ChildProcessError:  # this was known before
        return True


def _signal(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def _wait(condition: Callable[[], bool], seconds: float) -> bool:
    """Wait until a condition holds; False if it does not within so many seconds."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(_LOOK_SECONDS)
    return True

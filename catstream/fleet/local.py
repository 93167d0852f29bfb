"""A cluster of Ray on this machine alone, on the loopback interface: a background process that keeps its nodes running.

The process is of this file's `main`. It starts Ray as the documentation of Ray does for several nodes on one machine,
starts a node again that died, and ends the cluster when it is told to, or when the program that started it ends. The
first node is the head: without it, the cluster ends, and is started again by `catstream fleet up`.
"""

from __future__ import annotations

import math
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

from catstream.errors import FleetError
from catstream.fleet.timing import (
    CLUSTER_END_SECONDS,
    CLUSTER_LOOK_SECONDS,
    CLUSTER_START_SECONDS,
    HEALTH_ANSWER_SECONDS,
    HEALTH_DELAY_SECONDS,
    HEALTH_FAILURES,
    HEALTH_SECONDS,
    NODES_SECONDS,
    RETURN_SECONDS,
)
from catstream.messages.storage import is_locked, lock, write_atomically
from catstream.wire.endpoint import private_folder

_ENDED = (0, 1)  # exit codes after SIGTERM: 1 if Ray has handled it
_DIED = 3  # exit code if the cluster has ended by itself
_STORE_BYTES = 80 << 20  # of Ray's object store: only models and states that are merged go through it


class LocalCluster:
    """The cluster of a folder; any process of this user can use it.

    Parameters
    ----------
    folder : for the token, the log, and the address while it runs; made by `start`
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self._process: subprocess.Popen[bytes] | None = None  # if this process has started it

    @property
    def running(self) -> bool:
        """Whether its process runs."""
        with suppress(OSError), (self.folder / "pid").open() as file:
            return is_locked(file.fileno())
        return False

    @property
    def death(self) -> str:
        """Why the cluster that this object has started has ended by itself, and the log that says more, or ""."""
        if self._process is None or self._process.poll() in (None, *_ENDED):
            return ""
        return self._reason()

    @property
    def address(self) -> str:
        """HOST:PORT of the head; empty if it does not run, or has not started yet."""
        with suppress(OSError):
            return (self.folder / "address").read_text() if self.running else ""
        return ""

    @property
    def variables(self) -> dict[str, str]:
        """The variables of a process that connects, or is a node."""
        token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(self.folder / "token")}
        # Ray listens on 127.0.0.1 only if it takes the machine for one that runs no cluster with others.
        loopback = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_USAGE_STATS_ENABLED": "0"}
        quiet = {"RAY_DEDUP_LOGS": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
        # A dead node is noticed after two seconds, one that hangs after six.
        limits = {
            "initial_delay": HEALTH_DELAY_SECONDS,
            "period": HEALTH_SECONDS,
            "timeout": HEALTH_ANSWER_SECONDS,
        }
        health = {f"RAY_health_check_{name}_ms": f"{1000 * seconds:.0f}" for name, seconds in limits.items()}
        health["RAY_health_check_failure_threshold"] = str(HEALTH_FAILURES)
        # A worker of Ray has a lower priority by default: other programs would starve the streams.
        workers = {"RAY_worker_niceness": "0", "RAY_OBJECT_STORE_ALLOW_SLOW_STORAGE": "1"}
        # Each node has idle workers, which any stream can have: by default Ray starts them for the first program only.
        prestart = {"RAY_enable_worker_prestart": "1", "RAY_prestart_worker_first_driver": "0"}
        prestart["RAY_preload_python_modules"] = "catstream.fleet.prestarted"
        return token | loopback | quiet | health | workers | prestart

    def start(self, nodes: int, cores: int | None = None, *, detach: bool = True) -> None:
        """Start the nodes node-1, node-2 ... and wait until all have started. Call it with a lock of the folder.

        Parameters
        ----------
        nodes : number of nodes
        cores : of each node, a whole number for Ray; None divides the cores of this machine among them, rounded up
        detach : whether it runs on when this process ends

        Raises
        ------
        FleetError
            If it does not start.
        """
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.folder.chmod(0o700)
        if not (self.folder / "token").exists():
            write_atomically(self.folder / "token", secrets.token_hex(32).encode(), mode=0o600)
        (self.folder / "address").unlink(missing_ok=True)
        cores = math.ceil(len(os.sched_getaffinity(0)) / nodes) if cores is None else cores
        command = [sys.executable, "-P", "-c", "from catstream.fleet.local import main; main()"]
        command += [str(self.folder), str(nodes), str(cores), "detached" if detach else "attached"]
        others = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
        with (self.folder / "log").open("wb") as log:
            process = subprocess.Popen(
                command,
                env=others | self.variables,
                stdin=subprocess.DEVNULL if detach else subprocess.PIPE,  # its end is the end of this process
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._process = process  # with the pipe
        deadline = time.monotonic() + CLUSTER_START_SECONDS
        try:
            while not self.address:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise FleetError(f"Ray does not start on this machine: {self._reason()}")
                time.sleep(CLUSTER_LOOK_SECONDS)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the cluster, and wait until it has ended."""
        deadline = time.monotonic() + CLUSTER_END_SECONDS
        while self.running:
            with suppress(OSError, ValueError):
                pid = int((self.folder / "pid").read_text())
                os.kill(pid, signal.SIGTERM if time.monotonic() < deadline else signal.SIGKILL)
                os.kill(pid, signal.SIGCONT)
            time.sleep(CLUSTER_LOOK_SECONDS)
        if self._process is not None:
            self._process.communicate()  # closes the pipe
            self._process = None

    def _reason(self) -> str:
        """The last line that the cluster has printed, and where the others are."""
        lines = (self.folder / "log").read_text(errors="replace").strip().splitlines()
        return f"{lines[-1] if lines else 'it printed nothing'}\nSee {self.folder / 'log'}"


def main() -> None:
    """Run the cluster of a folder until SIGTERM.

    The arguments are the folder, the number of nodes, their cores, and "attached" if it ends with its standard input.
    """
    folder, count, cores = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    ends = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda _number, _frame: ends.set())
    with (folder / "pid").open("a+") as file:
        if not lock(file.fileno()):
            sys.exit("the cluster runs already")
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        if sys.argv[4] == "attached":
            threading.Thread(target=_set_at_the_end_of_input, args=(ends,), daemon=True).start()
        with private_folder() as work:
            (work / "ray").mkdir()
            os.environ["RAY_TMPDIR"] = str(work)
            try:
                _keep(folder, count, cores, ends)
            except Exception:  # said in the log, whose last line `up` repeats; the exit code is that of a death
                traceback.print_exc()
    if not ends.is_set():
        sys.exit(_DIED)


def _set_at_the_end_of_input(ends: threading.Event) -> None:
    os.read(sys.stdin.fileno(), 1)  # not through the buffer, whose lock would be held when the process ends
    ends.set()


def _keep(folder: Path, count: int, cores: int, ends: threading.Event) -> None:
    from ray.cluster_utils import Cluster

    def options(number: int) -> dict[str, Any]:
        return {"node_name": f"node-{number}", "num_cpus": cores, "object_store_memory": _STORE_BYTES}

    cluster: Any = Cluster(initialize_head=True, head_node_args=options(1) | {"include_dashboard": False})
    try:
        nodes = {number: cluster.add_node(**options(number)) for number in range(2, count + 1)}
        due: dict[int, float] = {}  # moment from which a node that has died is started again
        write_atomically(folder / "address", cluster.address.encode(), mode=0o600)
        while not ends.wait(NODES_SECONDS):
            if _has_died(cluster.head_node):
                print("the head, node-1, has died", flush=True)
                return
            for number, node in nodes.items():
                if node is not None and _has_died(node):
                    print(f"node-{number} has died, and starts again in {RETURN_SECONDS:g} s", flush=True)
                    cluster.remove_node(node, allow_graceful=False)
                    nodes[number], due[number] = None, time.monotonic() + RETURN_SECONDS
                elif node is None and time.monotonic() >= due[number]:
                    nodes[number] = _start_again(cluster, options(number))
    finally:  # Ray ends this process on SIGTERM
        (folder / "address").unlink(missing_ok=True)
        cluster.shutdown()


def _start_again(cluster: Any, options: dict[str, Any]) -> Any:
    """Add a node; None if it has not started within the time that Ray gives it, for example on a busy machine."""
    before = _children()
    try:
        return cluster.add_node(**options)
    except Exception as error:  # Ray has no type for it
        print(f"{options['node_name']} does not start: {error}", flush=True)
        for pid in _children() - before:  # else it might start later, beside the next one of its name
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return None


def _children() -> set[int]:
    """The processes that this thread has started; none, if the kernel does not list them."""
    with suppress(FileNotFoundError):
        return set(map(int, Path("/proc/thread-self/children").read_text().split()))
    return set()


def _has_died(node: Any) -> bool:
    """Whether a node of Ray, or the state of the cluster on it, has died."""
    return any(kind in ("raylet", "gcs_server") for kind, _ in node.dead_processes())

"""The client of a fleet: starts, changes and monitors its streams.

    import catstream

    with catstream.Fleet("fleet.toml") as fleet:
        fleet.up()
        print(fleet.status().streams["cam-7"].state)

A fleet runs on a cluster of Ray that its users have started (`ray start`, KubeRay), and continues after the program.
Without a cluster, `up` starts a Ray node on the loopback interface, which ends with the program. Programs that only
subscribe need neither Ray nor its token: see `catstream.subscribe`.

A fleet on this machine has a folder, `~/.local/state/catstream/fleets/NAME`:

    lock      locked by the process that has started the Ray node
    address   address of this node, once it has started
    token     Ray's token, so that other users of this machine cannot run code there
    store/    states of the streams, unless the file of the fleet has another store
    logs/     logs of Ray and the streams, once the fleet has ended
    keys/     keys of the clients of a fleet on a cluster, on the machine of the registry
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import signal
import socket
import sys
import threading
import time
import warnings
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil

from catstream.base.files import is_locked, lock, state_home, write_atomically
from catstream.client.registry import REGISTRY_PORT
from catstream.client.saved_model import SavedModel
from catstream.errors import CatstreamError, FleetError, require_fleet
from catstream.fleet.controller import NAMESPACE, Controller, actor_name, named_actors
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.fleet.store import CONNECT_SECONDS, Store
from catstream.wire.discovery import private_folder
from catstream.wire.messages import FleetStatus

ANSWER_SECONDS = 60.0  # timeout for an answer of the controller, which includes a restart by Ray
DOWN_SECONDS = 60.0  # timeout for all streams to store their state and to end
_LEAVE_SECONDS = 10.0  # timeout for the process that has started the node to detect the end of the fleet
_LOOK_SECONDS = 0.2  # polling interval for these
_STORE_BYTES = 80 << 20  # size of Ray's object store, which transfers only saved models

#: Environment of a node that `up` starts. Ray listens only on 127.0.0.1 if clusters are disabled, an option for Windows
#: and macOS. By default, it lowers the priority of its workers, so streams would starve next to other work, and records
#: tasks for `ray list`, whose last records would delay the end by seconds if the head is dead.
_VARIABLES = {
    "RAY_AUTH_MODE": "token",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_task_events_report_interval_ms": "0",
    "RAY_worker_niceness": "0",
}


class Fleet(AbstractContextManager["Fleet"]):
    """Connects to the controller of a fleet, which `up` starts. Use it in a `with`.

    Parameters
    ----------
    spec : path or FleetSpec
        The file fleet.toml, or its content. Needed only for `up`.
    name : str
        Name of the fleet; by default the name in the spec, or the only fleet that runs.
    address : str
        HOST:PORT of the head of a cluster of Ray, of which this machine is a node; by default RAY_ADDRESS. If both are
        empty, the fleet runs only on this machine.

    Raises
    ------
    FleetError
        By the constructor, if the spec is invalid or the fleet does not exist. By each method, if the controller
        cannot be reached or rejects the call; the message names the stream and the node.
    MissingExtraError
        If Ray is not installed.
    """

    def __init__(
        self, spec: str | os.PathLike[str] | FleetSpec | None = None, *, name: str = "", address: str = ""
    ) -> None:
        require_fleet()
        read = spec if isinstance(spec, FleetSpec) or spec is None else FleetSpec.load(Path(spec))
        self._spec = replace(read, name=name) if read is not None and name else read
        self._address = address or os.environ.get("RAY_ADDRESS", "")
        self.name = name or (read.name if read is not None else "")
        if not self.name and not self._address:
            folders = sorted((state_home() / "fleets").glob("*"))
            self.name = _only([folder.name for folder in folders if _is_up(folder)], "this machine")
        self._owned: ExitStack | None = None  # the Ray node that `up` has started
        self._node: dict[str, psutil.Process] = {}  # its processes, all of which are needed to supervise the streams
        self._controller: Any = None

    @property
    def is_owner(self) -> bool:
        """True if the fleet ends with this object, because `up` started Ray for it."""
        return self._owned is not None

    def up(self) -> list[str]:
        """Make the spec the desired state; returns a line for each stream with its change.

        Unchanged streams continue to run. If the store is unusable, nothing is started or changed.
        """
        if self._spec is None:
            raise FleetError("missing fleet file: the fleet has no streams yet; pass a file as in docs/how-to/fleet.md")
        spec = self._spec
        if not spec.store:
            if self._address:
                raise FleetError(
                    f'the fleet {self.name} needs a store that all nodes can reach: store = "s3://BUCKET/PREFIX"'
                )
            spec = replace(spec, store=str(self._folder / "store"))
        Store(spec.store).check()
        models = _models(spec.streams.values())
        was_owner = self.is_owner
        try:
            if not self._address and not was_owner:
                self._start_ray()
            self._connect()
            self._start_controller(spec)
            lines: list[str] = self._ask("apply", spec, models)
        except BaseException:
            if not was_owner:  # a controller that another process has started continues
                self._end_ray()
            raise
        return lines

    def add(self, spec: StreamSpec) -> list[str]:
        """Add a stream, or replace the stream of the same name."""
        lines: list[str] = self._ask("add", spec, _models([spec]))
        return [line for line in lines if line.startswith(f"{spec.name}:")]

    def remove(self, *names: str, forget: bool = False) -> list[str]:
        """Remove streams. Unless `forget`, their states remain in the store: they continue if they are added again."""
        self._ask("remove", names)
        if forget:
            store = Store(self._ask("spec").store)
            for name in names:
                store.stream(name).clear()  # supersedes its actor, if it is still running
        return [f"{name}: is removed" for name in names]

    def status(self) -> FleetStatus:
        """The state of all streams and nodes."""
        answer: FleetStatus = self._ask("status")
        return answer

    def down(self) -> list[str]:
        """Stop all streams after storing their states, then the controller and, for a local fleet, Ray.

        Returns a line for each stream whose last state could not be stored.
        """
        deadline = time.monotonic() + DOWN_SECONDS
        while (running := self._ask("close")) and time.monotonic() < deadline:
            time.sleep(_LOOK_SECONDS)
        late = [f"{name}: it did not stop within {DOWN_SECONDS:g} s" for name in running]
        if late and not self.is_owner:  # the node of an owner ends anyway
            raise FleetError("\n".join([f"the fleet {self.name} is not down yet, run the command again", *late]))
        unstored: list[str] = late + self._ask("end")
        import ray

        with suppress(ValueError):  # the controller has ended
            ray.kill(ray.get_actor(actor_name(self.name, "controller"), namespace=NAMESPACE))
        self._end_ray()
        deadline = time.monotonic() + _LEAVE_SECONDS
        while not self._address and _is_up(self._folder) and time.monotonic() < deadline:
            time.sleep(_LOOK_SECONDS)
        return unstored

    @property
    def is_running(self) -> bool:
        """True if its controller is running."""
        self._connect()
        return actor_name(self.name, "controller") in named_actors()

    def close(self) -> None:
        """Disconnect; stops the fleet if this object has started Ray for it."""
        if self.is_owner and self.is_running:
            self.down()
        self._end_ray()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _folder(self) -> Path:
        """The folder of the fleet on this machine."""
        return state_home() / "fleets" / self.name

    def _start_ray(self) -> None:
        """Start a Ray node on the loopback interface, unless another process has started it."""
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with ExitStack() as stack:
            file = stack.enter_context((self._folder / "lock").open("w"))
            if not lock(file.fileno()):
                return
            (self._folder / "address").unlink(missing_ok=True)  # of a killed process
            if not (self._folder / "token").exists():
                write_atomically(self._folder / "token", secrets.token_hex(32).encode(), mode=0o600)
            files = stack.enter_context(private_folder())
            stack.callback(self._keep_logs, files)
            stack.callback(_disconnect)
            self._init(
                _node_ip_address="127.0.0.1",
                _temp_dir=str(files),
                include_dashboard=False,
                object_store_memory=_STORE_BYTES,
            )
            stack.callback((self._folder / "address").unlink, missing_ok=True)
            write_atomically(self._folder / "address", _gcs_address().encode(), mode=0o600)
            children = {child.name(): child for child in psutil.Process().children()}
            self._node = {name: children[name] for name in ("gcs_server", "raylet")}
            self._owned = stack.pop_all()

    def _check_node(self) -> None:
        """End the Ray node that `up` has started, and raise FleetError, if one of its processes has died."""
        for name, process in self._node.items():
            with suppress(psutil.TimeoutExpired):
                status = process.wait(0)
                for each in self._node.values():  # a raylet without its head would continue for a minute
                    _kill(each)
                self._end_ray()
                raise FleetError(
                    f"the fleet {self.name} has ended, because Ray's {name} has died (exit status {status}): start it "
                    f"again; its logs are in {self._folder / 'logs'}"
                )

    def _keep_logs(self, files: Path) -> None:
        """Move the logs of Ray and the streams from the temporary folder of a node to the fleet's folder."""
        shutil.rmtree(self._folder / "logs", ignore_errors=True)
        with suppress(OSError):
            shutil.move(files / "session_latest" / "logs", self._folder / "logs")

    def _connect(self) -> None:
        """Connect this process to the cluster, if it is not connected yet."""
        if self._owned is not None:
            self._check_node()
            return
        address = self._address
        if not address:
            if not _is_up(self._folder):
                raise FleetError(f"no fleet {self.name!r} of yours runs on this machine: start it (catstream fleet up)")
            try:
                address = (self._folder / "address").read_text()
            except OSError:
                raise FleetError(f"the fleet {self.name} is starting: try again once it runs") from None
        host, _, port = address.rpartition(":")
        try:
            socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or "no answer"
            if not self._address:
                raise FleetError(f"the fleet {self.name} is ending, its Ray was killed ({why}): try again") from None
            raise FleetError(
                f"there is no cluster of Ray at {address!r} ({why}): expected HOST:PORT as `ray start --head` prints it"
            ) from None
        self._init(address)

    def _init(self, address: str | None = None, **options: Any) -> None:
        """Connect to a cluster, or start a node."""
        if not self._address:
            os.environ.update(_VARIABLES | {"RAY_AUTH_TOKEN_PATH": str(self._folder / "token")})
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "2")  # 41 s each if the head dies; the default is 20
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # FutureWarnings of Ray
            import ray

            if ray.is_initialized():
                if (other := _gcs_address()) != address:
                    raise FleetError(f"this process uses the cluster at {other}: it can use one cluster only")
                return
            handler = signal.getsignal(signal.SIGTERM)
            try:
                ray.init(
                    address or "local", namespace=NAMESPACE, log_to_driver=False, logging_level=logging.ERROR, **options
                )
            except Exception as error:  # Ray has no exception class for a failed start
                why = str(error).strip().partition("\n")[0]
                if address is None:
                    raise FleetError(f"Ray does not start on this machine: {why}") from None
                raise FleetError(
                    f"cannot connect to the cluster of Ray at {address}: {why}\nThis machine must be a node of it "
                    "(`ray start --address ...`), with the same versions of Python and Ray, and its token "
                    "(RAY_AUTH_MODE=token, RAY_AUTH_TOKEN_PATH)"
                ) from None
            if callable(handler) and threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, handler)  # Ray's handler would abort the process

    def _end_ray(self) -> None:
        """Disconnect, and end the node that this object has started."""
        self._controller, self._node, owned, self._owned = None, {}, self._owned, None
        if owned is not None:
            owned.close()
        else:
            _disconnect()

    def _start_controller(self, spec: FleetSpec) -> None:
        """Start the controller, if it is not running, on the node of the registry's address."""
        import ray

        options: dict[str, Any] = {}
        if self._address:
            registry = spec.registry or f"{_gcs_address().rpartition(':')[0]}:{REGISTRY_PORT}"
            listen, keys = f"tcp://{registry}", str(self._folder / "keys")
            options["resources"] = {f"node:{registry.rpartition(':')[0]}": 0.001}
        else:
            listen, keys = str(self._folder / "registry"), ""  # the same if Ray restarts the controller
        self._controller = (
            ray.remote(Controller)
            .options(
                name=actor_name(spec.name, "controller"),
                namespace=NAMESPACE,
                get_if_exists=True,
                lifetime="detached",
                num_cpus=0,
                max_restarts=-1,
                max_task_retries=-1,
                max_concurrency=8,
                **options,
            )
            .remote(spec.name, spec.store, listen, keys)
        )
        self._ask("ready")

    def _ask(self, method: str, *arguments: object) -> Any:
        """Call a method of the controller, and wait for its answer."""
        self._connect()
        import ray
        from ray.exceptions import GetTimeoutError, RayError, RayTaskError

        if self._controller is None:
            fleets = [name.removesuffix("/controller") for name in named_actors() if name.endswith("/controller")]
            self.name = self.name or _only(sorted(fleets), f"the cluster at {self._address}")
            try:
                self._controller = ray.get_actor(actor_name(self.name, "controller"), namespace=NAMESPACE)
            except ValueError:
                raise FleetError(
                    f"there is no fleet {self.name!r} on this cluster: start it with catstream fleet up"
                ) from None
        try:
            answer = getattr(self._controller, method).remote(*arguments)
            deadline = time.monotonic() + ANSWER_SECONDS
            while not ray.wait([answer], timeout=_LOOK_SECONDS)[0] and time.monotonic() < deadline:
                self._check_node()
            return ray.get(answer, timeout=0)
        except RayTaskError as error:
            if isinstance(error.cause, CatstreamError):
                raise error.cause from None
            what = str(error).strip().rpartition("\n")[2]
        except (RayError, GetTimeoutError) as error:
            self._controller = None
            what = str(error).partition("\n")[0] or type(error).__name__
        logs = "Ray's log folder" if self._address else f"{self._folder / 'logs'} once the fleet has ended"
        raise FleetError(f"the controller of fleet {self.name} failed ({what}): see its log in {logs}")


def _gcs_address() -> str:
    """HOST:PORT of the head of this process's cluster."""
    import ray

    return str(ray.get_runtime_context().gcs_address)


def _kill(process: psutil.Process) -> None:
    """Kill a process and its descendants."""
    with suppress(psutil.NoSuchProcess):
        for each in (process, *process.children(recursive=True)):
            with suppress(psutil.NoSuchProcess):
                each.kill()


def _disconnect() -> None:
    """Disconnect this process from the cluster, and end a node that it has started."""
    if (ray := sys.modules.get("ray")) is not None:
        ray.shutdown()


def _is_up(folder: Path) -> bool:
    """Return True if a process runs or starts the Ray node of a fleet on this machine."""
    with suppress(OSError), (folder / "lock").open() as file:
        return is_locked(file.fileno())
    return False


def _only(fleets: Sequence[str], where: str) -> str:
    if len(fleets) != 1:
        help_ = f"select one of {', '.join(fleets)} (--name)" if fleets else "start one with catstream fleet up"
        raise FleetError(f"{len(fleets)} fleets run on {where}: {help_}")
    return fleets[0]


def _models(streams: Iterable[StreamSpec]) -> dict[tuple[str, str], bytes]:
    """The contents of the saved models of streams, by stream and object."""
    contents = {}
    for stream in streams:
        for name, file in stream.models.items():
            SavedModel.load(file)  # validates it; errors name the file
            contents[stream.name, name] = file.read_bytes()
    return contents

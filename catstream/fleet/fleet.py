"""The streams of a fleet, from a program: start them, change them, and see how they are.

    import catstream

    with catstream.Fleet("fleet.toml") as fleet:
        fleet.up()
        print(fleet.status().streams["cam-7"].state)

A fleet runs on a cluster of Ray that its users have started, and continues after the program. Without one, it runs on
this machine as long as the program, or until `down`. Programs that only watch need neither Ray nor its token: see
`catstream.subscribe`.
"""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from catstream.client.registry import REGISTRY_PORT
from catstream.errors import CatstreamError, FleetError, require_extra
from catstream.fleet import cluster
from catstream.fleet.cluster import NAMESPACE, actor_name
from catstream.fleet.controller import Controller
from catstream.fleet.desired import Desired
from catstream.fleet.life import Node
from catstream.fleet.local import LocalCluster
from catstream.fleet.merge import Merged, merge_streams
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.fleet.store import Store
from catstream.fleet.timing import ANSWER_SECONDS, DOWN_SECONDS, ENDED_SECONDS
from catstream.messages.kinds import FleetStatus
from catstream.messages.names import UNNAMED, check_name
from catstream.messages.storage import lock
from catstream.run.learned import Learned


class Fleet:
    """Connects to the controller of a fleet, which `up` starts. Use it in a `with`.

    Parameters
    ----------
    spec : path or FleetSpec
        The file fleet.toml, or what was read from it. Needed for `up` only.
    name : str
        Name of the fleet; by default that of the spec, or the only one that runs.
    address : str
        HOST:PORT of the head of a cluster of Ray, of which this machine is a node; by default RAY_ADDRESS. If both are
        empty, the fleet runs on this machine alone.

    Attributes
    ----------
    is_owner : bool
        Whether the fleet ends with this object, because `up` started Ray for it.

    Raises
    ------
    FleetError
        From the constructor, if the spec is not valid, or there is no such fleet. From each method, if the controller
        cannot be reached or does not do it; the message names the stream and the node.
    MissingExtraError
        If Ray is not installed.
    """

    def __init__(
        self,
        spec: str | os.PathLike[str] | FleetSpec | None = None,
        *,
        name: str = "",
        address: str = "",
    ) -> None:
        require_extra("fleet")
        read = spec if isinstance(spec, FleetSpec) or spec is None else FleetSpec.load(Path(spec))
        self._spec = replace(read, name=name) if read is not None and name else read
        self._origin = "" if isinstance(spec, FleetSpec) or spec is None else _origin(Path(spec))
        self.name = name or (read.name if read is not None else "")
        self._address = address or os.environ.get("RAY_ADDRESS", "")
        self._local = None if self._address else self._on_this_machine()
        self.is_owner = False  # whether the cluster ends with this object
        self._controller: Any = None

    def up(
        self,
        *,
        nodes: int | None = None,
        cores: int | None = None,
        detach: bool = False,
        replace: bool = False,
        wait: bool = False,
    ) -> list[str]:
        """Make the spec the desired state; what runs and is unchanged is not touched.

        Parameters
        ----------
        nodes : int
            Number of nodes to start, for a fleet on this machine that does not run yet; by default that of the spec.
        cores : int
            Processor cores of each of them; by default an equal share of this machine's, rounded up.
        detach : bool
            Whether a fleet on this machine runs on after `close`, until `down`. On a cluster it always does.
        replace : bool
            Whether streams of another file that run under this name may be replaced.
        wait : bool
            Whether streams for which there are not enough nodes may wait for nodes that join later.

        Returns
        -------
        what is done, a line for each stream

        Raises
        ------
        StoreError
            If the store cannot be used. Nothing is started or changed then.
        """
        if self._spec is None:
            raise FleetError("there are no streams: give a file, see docs/how-to/fleet.md")
        with self._starting():
            spec = self._with_store(self._spec)
            models = _models(spec.streams.values())
            began = False
            with ExitStack() as undone:
                if self._local is not None and not self._local.running:
                    self._local.start(nodes or spec.nodes, cores, detach=detach)
                    undone.callback(self._local.stop)
                    undone.callback(self.disconnect)
                    began = True
                self._connect()
                if self.name not in cluster.fleets():
                    undone.callback(self._kill_controller)
                self._start_controller(spec)
                lines = self._change(
                    Desired.applied, spec, self._origin, replace_other=replace, models=models, may_wait=wait
                )
                undone.pop_all()
            self.is_owner = self.is_owner or (began and not detach)
            return lines

    def add(self, spec: StreamSpec) -> list[str]:
        """Add a stream, or change the one of the same name."""
        lines = self._change(Desired.added, spec, models=_models([spec]))
        return _about(lines, [spec.name])

    def remove(self, *names: str, forget: bool = False) -> list[str]:
        """Remove streams. Unless `forget`, their state stays in the store: they continue if they are added again."""
        lines = self._change(Desired.removed, names, may_wait=True)
        if forget:
            store = Store(self._ask("spec").store)
            for name in names:
                store.stream(name).clear()  # its actor is superseded, if it still runs
        return _about(lines, names)

    def move(self, name: str, node: str) -> str:
        """Move a stream to a node, where it stays until the node dies or drains."""
        there, streams = self._node(node), self.status().streams
        if name in streams and streams[name].state == "ended":
            raise FleetError(f"{name} has ended: it runs on no node")
        self._change(Desired.moved, name, there, may_wait=True)
        before = streams[name].node
        return f"{name} stays on {node}" if before == node else f"{name} moves from {before or 'no node'} to {node}"

    def drain(self, node: str, *, undo: bool = False) -> str:
        """Move all streams from a node and place none there, for example before it is switched off.

        Streams wait if the other nodes have no room for them.
        """
        there = self._node(node)
        count = sum(each.node == node for each in self.status().streams.values())
        self._change(Desired.drained, there, undo=undo, may_wait=True)
        return f"{node} takes streams again" if undo else f"{node} is draining; streams that leave it: {count}"

    def status(self) -> FleetStatus:
        """The state of all streams and nodes."""
        answer: FleetStatus = self._ask("status")
        return answer

    def logs(self, name: str, lines: int = 100) -> list[str]:
        """The last lines that a stream logged on its node."""
        answer: list[str] = self._ask("logs", name, lines)
        return answer

    def merge(self, *names: str, object: str = UNNAMED) -> Merged:
        """Merge what streams have learned of an object; the streams that follow it then search for it by the result.

        Parameters
        ----------
        names : str
            The streams; by default all that have learned of the object.
        object : str
            Name of the object; "" also means the only object of each stream.
        """
        spec: FleetSpec = self._ask("spec")
        for name in names:
            if name not in spec.streams:
                raise FleetError(f"there is no stream {name!r}: the streams are {', '.join(spec.streams) or 'none'}")
        return merge_streams(spec.store, names or spec.streams, check_name(object), named=bool(names))

    def down(self) -> list[str]:
        """Stop all streams after their state was stored, and the controller; on this machine alone, Ray too.

        Returns
        -------
        a line for each stream whose last state could not be stored
        """
        if self._local is not None and not self._local.running:
            raise FleetError(f"no fleet {self.name!r} of yours runs on this machine: see catstream fleet status")
        self.is_owner = False
        deadline = time.monotonic() + DOWN_SECONDS
        while self._ask("close") and time.monotonic() < deadline:
            time.sleep(ENDED_SECONDS)
        unstored: list[str] = self._ask("end")
        self._kill_controller()
        self.disconnect()
        if self._local is not None:
            self._local.stop()
        return unstored

    @property
    def is_running(self) -> bool:
        """Whether the cluster of a fleet on this machine still runs.

        Raises
        ------
        FleetError
            If it has ended by itself, for example because its head died.
        """
        if self._local is None or self._local.running:
            return True
        self.is_owner = False
        if death := self._local.death:
            raise FleetError(
                f"the fleet {self.name} has died with Ray; catstream fleet up continues from the last states: {death}"
            )
        return False

    def disconnect(self) -> None:
        """Disconnect from Ray until the next call of a method; the fleet runs on."""
        self._controller = None
        cluster.disconnect()

    def close(self) -> None:
        """Disconnect. A fleet on a cluster, or a detached one, continues; any other ends with this program."""
        if self.is_owner:
            self.down()
        self.disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _with_store(self, spec: FleetSpec) -> FleetSpec:
        """The spec with its store, which was checked, so that nothing is started for a store that cannot be used."""
        if not spec.store:
            if self._local is None:
                raise FleetError(
                    f'the fleet {self.name} needs a store that all nodes reach: store = "s3://BUCKET/PREFIX"'
                )
            spec = replace(spec, store=str(self._local.folder / "store"))
        Store(spec.store).check()
        return spec

    def _start_controller(self, spec: FleetSpec) -> None:
        """Start the controller, if it does not run, on the node whose address the registry has."""
        import ray

        options: dict[str, Any] = {}
        listen = ""
        if not cluster.is_local():
            head = ray.get_runtime_context().gcs_address.rpartition(":")[0]
            registry = spec.registry or f"{head}:{REGISTRY_PORT}"
            listen, options["resources"] = f"tcp://{registry}", {f"node:{registry.rpartition(':')[0]}": 0.001}
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
            .remote(spec.name, spec.store, listen, spec.keys or str(_home() / spec.name / "keys"))
        )
        self._ask("ready")

    def _kill_controller(self) -> None:
        import ray

        with suppress(ValueError):  # it has gone
            ray.kill(ray.get_actor(actor_name(self.name, "controller"), namespace=NAMESPACE))

    @contextmanager
    def _starting(self) -> Iterator[None]:
        """Wait while another process starts this fleet on this machine."""
        if self._local is None:
            yield
            return
        self._local.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with (self._local.folder / "starting").open("w") as file:
            lock(file.fileno(), math.inf)
            yield

    def _on_this_machine(self) -> LocalCluster:
        """The cluster of the fleet with the name, or of the only one that runs on this machine."""
        if not self.name:
            folders = sorted(_home().glob("*"))
            self.name = _only([each.name for each in folders if LocalCluster(each).running], "this machine")
        return LocalCluster(_home() / self.name)

    def _connect(self) -> None:
        if self._local is None:
            cluster.connect(self._address)
        elif address := self._local.address:
            cluster.connect(address, self._local.variables)
        elif self._local.running:
            raise FleetError(f"the fleet {self.name} is starting: try again once catstream fleet status shows it")
        else:
            raise FleetError(f"the fleet {self.name} does not run: start it with catstream fleet up")

    def _change(self, method: Callable[..., Desired], *arguments: object, **options: object) -> list[str]:
        """Let the controller change the desired state by one of its methods."""
        lines: list[str] = self._ask("change", method.__name__, *arguments, **options)
        return lines

    def _ask(self, method: str, *arguments: object, **options: object) -> Any:
        """Call a method of the controller, and wait for its answer."""
        self._connect()
        import ray
        from ray.exceptions import GetTimeoutError, RayError, RayTaskError

        if self._controller is None:
            self.name = self.name or _only(cluster.fleets(), f"the cluster at {self._address}")
            try:
                self._controller = ray.get_actor(actor_name(self.name, "controller"), namespace=NAMESPACE)
            except ValueError:
                raise FleetError(
                    f"there is no fleet {self.name!r} on this cluster: start it with catstream fleet up"
                ) from None
        try:
            return ray.get(getattr(self._controller, method).remote(*arguments, **options), timeout=ANSWER_SECONDS)
        except RayTaskError as error:
            if isinstance(error.cause, CatstreamError):
                raise error.cause from None
            what = str(error).strip().rpartition("\n")[2]
        except (RayError, GetTimeoutError) as error:
            self._controller = None
            what = str(error).partition("\n")[0] or type(error).__name__
        raise FleetError(f"the controller of {self.name} did not do it ({what}): see its log in the folder of Ray")

    def _node(self, name: str) -> Node:
        """The living node of the cluster with a name."""
        self._connect()
        known = {node.name: node for node in cluster.nodes() if node.alive}
        if name not in known:
            raise FleetError(f"there is no node {name!r}, or it has died: there are {', '.join(known) or 'none'}")
        return known[name]


def _home() -> Path:
    """The folder with one for each fleet of this user."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "catstream" / "fleets"


def _only(fleets: Sequence[str], place: str) -> str:
    """The only fleet of a place."""
    if len(fleets) != 1:
        help_ = f"say which (--name), there are {', '.join(fleets)}" if fleets else "start one with catstream fleet up"
        raise FleetError(f"{len(fleets)} fleets run on {place}: {help_}")
    return fleets[0]


def _about(lines: Iterable[str], names: Collection[str]) -> list[str]:
    """The lines of a change about some streams."""
    return [line for line in lines if line.partition(":")[0] in names]


def _origin(file: Path) -> str:
    """Machine and path of a file."""
    return f"{socket.gethostname()}:{file.resolve()}"


def _models(streams: Iterable[StreamSpec]) -> dict[tuple[str, str], bytes]:
    """The contents of the saved models that specs name, by stream and object."""
    found = {}
    for stream in streams:
        for name, file in stream.models.items():
            Learned.load(file)  # its errors name the file
            found[stream.name, name] = file.read_bytes()
    return found

"""The streams of a fleet, from a program: start them, change them, and see how they are.

    import catstream

    with catstream.Fleet("fleet.toml") as fleet:
        fleet.up()
        print(fleet.status().streams["cam-7"].state)

The fleet goes on after the program ends; `down` ends it. It changes nothing for who only watches: they need neither Ray
nor the token, see `catstream.subscribe`.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from catstream.errors import CatstreamError, FleetError
from catstream.extras import require_extra
from catstream.fleet.cluster import HEAD_RESOURCE, NAMESPACE, connect, disconnect
from catstream.fleet.local import LocalFleet
from catstream.fleet.manager import Manager, actor_name
from catstream.fleet.merge import Merged, merge_streams
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.learned import Learned
from catstream.messages import FleetStatus
from catstream.names import UNNAMED, check_name

__all__ = ["Fleet"]

_ANSWER_SECONDS = (20.0, 60.0)  # limits for the manager to answer, and to start before that
_DOWN_SECONDS = 60.0  # limit for all streams to store their state and to end
_TURN_SECONDS = 0.2
_MANAGER = actor_name("", "manager")  # how the names of the managers end

_log = logging.getLogger(__name__)


class Fleet:
    """Connects to the manager of a fleet; `up` starts it, on this machine or on a cluster of Ray. Use it in a `with`.

    Parameters
    ----------
    spec : path or FleetSpec
        The file fleet.toml, or what was read from it. Needed for `up` only.
    name : str
        Name of the fleet; by default that of the spec, or the only one that runs.
    address : str
        HOST:PORT of the head of a cluster. Empty for a fleet on this machine alone, which `up` starts.
    token_file : path
        File with the token of the cluster, with an address. Whoever has it can run any code on the cluster.
    folder : path
        Folder of a fleet on this machine; by default the one of its name in $XDG_STATE_HOME/catstream/fleets.

    Raises
    ------
    FleetError
        From the constructor, if the spec is not valid, or there is no such fleet. From each method, if the manager
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
        token_file: str | os.PathLike[str] | None = None,
        folder: str | os.PathLike[str] | None = None,
    ) -> None:
        require_extra("fleet")
        self._spec = spec if isinstance(spec, FleetSpec) or spec is None else FleetSpec.load(Path(spec))
        self.name = name or (self._spec.name if self._spec is not None else "")
        self._address, self._token_file = address, Path(token_file) if token_file is not None else None
        self._local = None if address else LocalFleet(Path(folder)) if folder is not None else self._local_fleet()
        self._manager: Any = None

    def up(self, *, nodes: int | None = None, cores: float | None = None) -> list[str]:
        """Make the spec the desired state; what runs and is unchanged is not touched.

        Parameters
        ----------
        nodes : int
            Number of nodes to start, for a fleet on this machine that does not run yet; by default that of the spec.
        cores : float
            Processor cores of each of them; by default an equal share of this machine's.

        Returns
        -------
        what is done, a line for each stream
        """
        if self._spec is None:
            raise FleetError("there are no streams: give a file, see docs/how-to/fleet.md")
        if self._local is not None:
            self._local.start(nodes or self._spec.nodes, cores)
            if not self._spec.store:
                self._spec = replace(self._spec, store=str(self._local.folder / "store"))
        elif not self._spec.store:
            raise FleetError(f'the fleet {self.name} needs a store that all nodes reach: store = "s3://BUCKET/PREFIX"')
        self._connect()
        import ray

        self._manager = (
            ray.remote(Manager)
            .options(
                name=actor_name(self._spec.name, "manager"),
                namespace=NAMESPACE,
                get_if_exists=True,
                lifetime="detached",
                num_cpus=0,
                resources={HEAD_RESOURCE: 0.001},
                max_restarts=-1,
                max_task_retries=-1,
                max_concurrency=8,
            )
            .remote(self._spec.name, self._spec.store, local=self._local is not None)
        )
        lines: list[str] = self._ask("apply", self._spec.to_json(), _models(self._spec.streams.values()))
        return lines

    def add(self, spec: StreamSpec) -> list[str]:
        """Add a stream, or change the one of the same name."""
        lines: list[str] = self._ask("add", spec, _models([spec]))
        return lines

    def remove(self, *names: str, forget: bool = False) -> list[str]:
        """Remove streams. Unless `forget`, their state stays in the store: they continue if they are added again."""
        answer: list[str] = self._ask("remove", list(names), forget=forget)
        return answer

    def move(self, name: str, node: str) -> str:
        """Move a stream to a node, where it stays as long as the node can have it."""
        answer: str = self._ask("move", name, node)
        return answer

    def drain(self, node: str, *, undo: bool = False) -> str:
        """Give all streams of a node away and place none there, for example before it is switched off."""
        answer: str = self._ask("drain", node, undo=undo)
        return answer

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
        spec = FleetSpec.from_json(self._ask("spec"))
        for name in names:
            if name not in spec.streams:
                raise FleetError(f"there is no stream {name!r}: the streams are {', '.join(spec.streams) or 'none'}")
        return merge_streams(spec.store, names or spec.streams, check_name(object), named=bool(names))

    def down(self) -> None:
        """Stop all streams after their state was stored, and the manager; on this machine alone, the nodes too."""
        if self._local is not None and not (self._local.running or self._local.names):
            raise FleetError(f"no fleet {self.name!r} of yours runs on this machine: see catstream fleet status")
        try:
            if self._local is None or self._local.running:
                self._stop_streams()
        except FleetError as error:
            if self._local is None:
                raise
            _log.warning("%s: the streams end with their last states in the store", error)
        if self._local is not None:
            self.close()
            self._local.stop()

    def _stop_streams(self) -> None:
        deadline = time.monotonic() + _DOWN_SECONDS
        while self._ask("close") and time.monotonic() < deadline:
            time.sleep(_TURN_SECONDS)
        self.end_manager()

    def end_manager(self) -> None:
        """End the manager, and leave streams and nodes as they are; `up` starts another one."""
        self._ask("spec")  # it is connected then
        import ray

        ray.kill(self._manager)
        self._manager = None

    def close(self) -> None:
        """Disconnect; the fleet goes on."""
        self._manager = None
        disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _local_fleet(self) -> LocalFleet:
        """The fleet of this machine with the name, or the only one that runs."""
        home = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "catstream" / "fleets"
        if self.name:
            return LocalFleet(home / self.name)
        running = [each for folder in sorted(home.glob("*")) if (each := LocalFleet(folder)).running]
        if len(running) != 1:
            known = (
                f": say which (--name), there are {', '.join(each.folder.name for each in running)}" if running else ""
            )
            raise FleetError(
                f"{len(running)} fleets run on this machine{known or ': start one with catstream fleet up'}"
            )
        self.name = running[0].folder.name
        return running[0]

    def _connect(self) -> None:
        if self._local is not None:
            if not self._local.running:
                raise FleetError(f"the fleet {self.name} does not run: start it with catstream fleet up")
            connect(self._local.address, self._local.token_file)
        elif self._token_file is None:
            raise FleetError(f"the cluster at {self._address} needs its token: give the file (--token-file)")
        else:
            connect(self._address, self._token_file)

    def _ask(self, method: str, *arguments: object, **options: object) -> Any:
        """Call a method of the manager, and wait for its answer; connects again if the head has started again."""
        self._connect()  # before Ray is imported, which reads its variables then
        from ray.exceptions import GetTimeoutError, RayError, RayTaskError

        why = ""
        for seconds in _ANSWER_SECONDS:
            try:
                return self._call(method, seconds, *arguments, **options)
            except RayTaskError as error:
                if isinstance(error.cause, CatstreamError):
                    raise error.cause from None
                raise
            except (RayError, GetTimeoutError) as error:
                why = str(error).partition("\n")[0] or type(error).__name__
                self.close()
        raise FleetError(f"the manager of {self.name} does not answer ({why}): is its head running?")

    def _call(self, method: str, seconds: float, *arguments: object, **options: object) -> Any:
        import ray

        if self._manager is None:
            self._connect()
            self.name = self.name or self._only_fleet()
            try:
                self._manager = ray.get_actor(actor_name(self.name, "manager"), namespace=NAMESPACE)
            except ValueError:
                raise FleetError(
                    f"there is no fleet {self.name!r} on this cluster: start it with catstream fleet up"
                ) from None
        return ray.get(getattr(self._manager, method).remote(*arguments, **options), timeout=seconds)

    def _only_fleet(self) -> str:
        """The name of the only fleet of the connected cluster."""
        from ray.util import list_named_actors

        actors = [each["name"] for each in list_named_actors(all_namespaces=True) if each["namespace"] == NAMESPACE]
        names: list[str] = sorted(each.removesuffix(_MANAGER) for each in actors if each.endswith(_MANAGER))
        if len(names) != 1:
            help_ = (
                f"say which (--name), there are {', '.join(names)}" if names else "start one with catstream fleet up"
            )
            raise FleetError(f"{len(names)} fleets run on the cluster at {self._address}: {help_}")
        return names[0]


def _models(streams: Iterable[StreamSpec]) -> dict[tuple[str, str], bytes]:
    """The contents of the saved models that specs name, by stream and object."""
    found = {}
    for stream in streams:
        for name, file in stream.models.items():
            Learned.load(file)  # its errors name the file
            found[stream.name, name] = file.read_bytes()
    return found

"""The controller of a fleet: an actor of Ray that compares the streams that should run with the actors that do.

What should run is in the store, and the streams are actors with names, so a controller that Ray starts again finds
both, and touches no stream that runs. What is done in each case is the table of `catstream.fleet.life`. Three kinds of
threads share the state: one looks at the actors twice a second, one answers the registry, and calls of
`catstream.fleet.Fleet` come in threads of Ray. Only the last ones use the store, so a store that hangs delays
nothing but the change that waits for it. What is answered as done is stored.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from catstream.client.registry import RegistryServer
from catstream.errors import CatstreamError, FleetError
from catstream.fleet import life
from catstream.fleet.cluster import NAMESPACE, is_local, nodes
from catstream.fleet.life import Node, Order, Seen, Wanted
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.fleet.store import Store
from catstream.fleet.stream import Place, Report, Stream, given_model
from catstream.messages.kinds import FleetStatus, NodeState, NodeStatus, StreamStatus
from catstream.video.frames import without_password
from catstream.wire.keys import Client, allowed, create

__all__ = ["Controller", "Record", "actor_name"]

#: Contents of saved models, by stream and object.
Models = dict[tuple[str, str], bytes]

_TURN_SECONDS = 0.5  # between two looks at the actors
_QUESTION_SECONDS = 0.1  # between two looks at the questions of the registry
_CLIENTS_SECONDS = 5.0  # between two looks at the keys of the clients
_ANSWER_SECONDS = 10.0  # limit for a stream to answer a call that a person waits for
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 60.0  # before an actor that was gone is started again, doubled each time

_log = logging.getLogger(__name__)


def actor_name(fleet: str, kind: str, stream: str = "") -> str:
    """The name of an actor: of the controller, or of a stream.

    >>> actor_name("site", "stream", "cam-7"), actor_name("site", "controller")
    ('site/stream/cam-7', 'site/controller')
    """
    return "/".join(filter(None, (fleet, kind, stream)))


@dataclass(frozen=True, slots=True)
class Record:
    """The desired state of a fleet, as it is kept in the store.

    spec      the streams
    origin    machine and file that the streams came from
    pins      name of the node that each stream was moved to
    draining  names of the nodes that streams leave
    """

    spec: FleetSpec
    origin: str = ""
    pins: dict[str, str] = field(default_factory=dict)
    draining: frozenset[str] = frozenset()

    def to_json(self) -> str:
        """The text that `from_json` reads."""
        own = {"origin": self.origin, "pins": self.pins, "draining": sorted(self.draining)}
        return json.dumps(own | {"spec": self.spec.to_json()})

    @classmethod
    def from_json(cls, text: str) -> Record:
        """Read what `to_json` wrote.

        Raises
        ------
        FleetError
            If it is something else.
        """
        try:
            read = json.loads(text)
            spec, draining = FleetSpec.from_json(read["spec"]), frozenset(map(str, read["draining"]))
            return cls(spec, str(read["origin"]), dict(read["pins"]), draining)
        except (ValueError, KeyError, TypeError) as error:
            raise FleetError(f"the desired state in the store is damaged ({error!r}): apply the file again") from None

    def wanted(self, name: str) -> Wanted:
        """A stream as it should run."""
        spec = self.spec.streams[name]
        return Wanted(spec.digest, spec.cores, spec.labels, self.pins.get(name, ""))


class StreamActor(Stream):
    """A stream as an actor of Ray, which tells the stream where it was placed."""

    def __init__(self, spec: StreamSpec, order: Order, clients: dict[str, Client] | None, store: str, every: float):
        import ray

        node = ray.get_runtime_context().get_node_id()
        address = "" if clients is None else ray.util.get_node_ip_address()
        super().__init__(spec, order, Place(node, address, clients or {}), store, every)


class _Pause(NamedTuple):
    """The pause before an actor is started that was gone: until when, and its length."""

    until: float
    seconds: float


@dataclass(slots=True)
class _Actor:
    """The actor of a stream.

    handle   of Ray
    seen     its state
    report   its last report
    call     the call for the next report, or that stops it, which was not answered yet
    """

    handle: Any
    seen: Seen
    report: Report | None = None
    call: Any = None


class Controller:
    """Runs as one actor of a fleet; the methods without an underscore are called by `catstream.fleet.Fleet`.

    Parameters
    ----------
    name : name of the fleet
    store : URL of the store
    listen : tcp://HOST:PORT at which the registry listens; empty for a Unix socket
    keys : folder of the keys of the clients; not used if all are on this machine

    """

    def __init__(self, name: str, store: str, listen: str, keys: str) -> None:
        self._name, self._store = name, Store(store)
        self._keys = None if is_local() else Path(keys).expanduser()
        self._record = Record(FleetSpec(name, store))
        self._trouble: CatstreamError | None = None  # why it cannot begin
        self._changing = threading.Lock()  # held by a change while it is stored
        self._lock = threading.RLock()  # of what follows, held for moments only
        self._nodes: list[Node] = []
        self._actors: dict[str, _Actor] = {}
        self._ended: dict[str, str] = {}  # digest of each stream that has ended
        self._pauses: dict[str, _Pause] = {}
        self._last: dict[str, StreamStatus] = {}  # the last report of each stream
        self._restarts: dict[str, int] = {}
        self._clients: dict[str, Client] | None = None if self._keys is None else {}
        self._clients_due = 0.0
        self._closing = False
        self._logged = ""  # the last error of a turn
        self._recent = FleetStatus(name, time.time())
        self._begun, self._over = threading.Event(), threading.Event()
        self._threads: list[threading.Thread] = []
        self._registry: RegistryServer | None = None
        try:
            if self._keys is not None:
                create(self._keys)
            self._registry = RegistryServer(listen, str(self._keys or ""), lambda: self._recent)
            self._begin()
        except CatstreamError as error:
            self._trouble = error
        self._start_thread(self._run)

    # What `Fleet` calls.

    def ready(self) -> None:
        """Return if it has begun.

        Raises
        ------
        CatstreamError
            If it has not: its address is in use, or the desired state cannot be read from the store.
        """
        if self._trouble is not None:
            raise self._trouble

    def apply(
        self,
        text: str,
        models: Models | None = None,
        origin: str = "",
        *,
        replace_other: bool = False,
        may_wait: bool = False,
    ) -> list[str]:
        """Make a spec the desired state; returns what will be done, a line for each stream.

        Parameters
        ----------
        text : the spec, as `FleetSpec.to_json` writes it
        models : contents of the saved models that it names, by stream and object
        origin : machine and file of the spec
        replace_other : whether the streams of another file may be replaced
        may_wait : whether streams may wait for nodes that join later

        Raises
        ------
        FleetError
            If the streams of another file run, or not all streams can run. Nothing is changed then.
        StoreError
            If the change cannot be stored. Nothing is changed then.
        """
        spec = FleetSpec.from_json(text)
        with self._changing:
            record = self._record
            if spec.store != record.spec.store:
                raise FleetError(
                    f"the fleet {self._name} keeps its state in {record.spec.store!r}, and the file says "
                    f"{spec.store!r}: end it first (catstream fleet down), and copy the state"
                )
            if origin and record.origin not in ("", origin) and record.spec.streams and not replace_other:
                raise FleetError(
                    f"the fleet {self._name} runs the streams of {record.origin}, not of {origin}: give this one "
                    "another name (--name), or replace the streams (--replace)"
                )
            record = replace(record, spec=spec, origin=origin or record.origin)
            return self._changed(record, models, may_wait=may_wait)

    def add(self, spec: StreamSpec, models: Models | None = None) -> list[str]:
        """Add a stream to those that there are, or change the one of its name."""
        with self._changing:
            streams = self._record.spec.streams | {spec.name: spec}
            lines = self._changed(self._with_streams(streams), models)
        return [line for line in lines if line.startswith(f"{spec.name}:")]

    def remove(self, names: list[str], *, forget: bool) -> list[str]:
        """Remove streams; their states stay in the store, unless they are to be forgotten."""
        with self._changing:
            for name in names:
                self._check_stream(name)
            left = {name: each for name, each in self._record.spec.streams.items() if name not in names}
            lines = self._changed(self._with_streams(left))
            for name in names if forget else ():
                self._store.remove(name)  # its actor is superseded, if it still runs
        return [line for line in lines if line.partition(":")[0] in names]

    def move(self, name: str, node: str) -> str:
        """Move a stream to a node, where it runs whenever the node lives."""
        with self._changing:
            self._check_stream(name)
            self._check_node(node)
            record = replace(self._record, pins=self._record.pins | {name: node})
            there = [each for each in self._nodes if each.name == node]
            if reason := life.objection(name, record.wanted(name), there):
                raise FleetError(reason)
            before = self.status().streams[name].node
            self._changed(record)
        return f"{name} stays on {node}" if before == node else f"{name} moves from {before or 'no node'} to {node}"

    def drain(self, node: str, *, undo: bool) -> str:
        """Move all streams from a node and place none there, or take that back."""
        with self._changing:
            self._check_node(node)
            draining = self._record.draining - {node} if undo else self._record.draining | {node}
            count = sum(each.node == node for each in self.status().streams.values())
            self._changed(replace(self._record, draining=draining))
        return f"{node} takes streams again" if undo else f"{node} is draining: its {count} streams move to other nodes"

    def status(self) -> FleetStatus:
        """The state of all streams and nodes."""
        with self._lock:
            streams = {name: self._stream_status(name) for name in sorted(self._record.spec.streams)}
            return FleetStatus(self._name, time.time(), streams, self._node_statuses(streams))

    def spec(self) -> str:
        """The desired streams, as `FleetSpec.to_json` writes them."""
        return self._record.spec.to_json()

    def logs(self, name: str, lines: int) -> list[str]:
        """The last lines that a stream logged."""
        self._check_stream(name)
        actor = self._actors.get(name)
        if actor is None or actor.seen.state == "pending":
            raise FleetError(f"{name} runs on no node now, so its log cannot be read: see catstream fleet status")
        import ray

        logged: list[str] = ray.get(actor.handle.logs.remote(lines), timeout=_ANSWER_SECONDS)
        return logged

    def close(self) -> int:
        """Stop all streams after their state was stored; returns how many still run."""
        self._closing = True
        return len(self._actors)

    def end(self) -> None:
        """End the threads, and the registry; the streams run on."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        if self._registry is not None:
            self._registry.close()

    # Changes.

    def _with_streams(self, streams: dict[str, StreamSpec]) -> Record:
        """The record with other streams: of those that are removed, nothing is left."""
        pins = {name: node for name, node in self._record.pins.items() if name in streams}
        return replace(self._record, spec=replace(self._record.spec, streams=streams), pins=pins)

    def _changed(self, record: Record, models: Models | None = None, *, may_wait: bool = False) -> list[str]:
        """Store a record, and then let it be what is desired; returns a line for each stream."""
        self.ready()
        streams = {name: record.wanted(name) for name in record.spec.streams}
        reasons = [life.objection(name, wanted, self._nodes) for name, wanted in streams.items()]
        reasons += [life.shortage(streams.values(), self._nodes)] if not any(reasons) else []
        if any(reasons) and not may_wait:
            raise FleetError(
                "nothing was changed: "
                + "\n".join(filter(None, reasons))
                + "\nGive streams fewer cores (catstream fleet status shows what they use), add nodes, or let streams "
                "wait for nodes that join later (catstream fleet up --wait)"
            )
        for (stream, name), data in (models or {}).items():
            self._store.put_model(given_model(stream, name), data, {})
        self._store.put_fleet(record.to_json())
        with self._lock:
            lines: list[str] = self._record.spec.changes(record.spec)
            self._record, self._closing = record, False
            for known in (self._ended, self._pauses, self._last, self._restarts):
                for name in known.keys() - streams.keys():
                    del known[name]
            for name in [name for name, digest in self._ended.items() if streams[name].digest != digest]:
                del self._ended[name]
            self._recent = self.status()
        return lines

    def _check_stream(self, name: str) -> None:
        if name not in self._record.spec.streams:
            known = ", ".join(self._record.spec.streams) or "none"
            raise FleetError(f"there is no stream {name!r} in the fleet {self._name}: there are {known}")

    def _check_node(self, name: str) -> None:
        known = [node.name for node in self._nodes]
        if name not in known:
            raise FleetError(f"there is no node {name!r} in the fleet {self._name}: there are {', '.join(known)}")

    # The loops.

    def _start_thread(self, task: Callable[[], None]) -> None:
        self._threads.append(threading.Thread(target=task, daemon=True))
        self._threads[-1].start()

    def _begin(self) -> None:
        """Read what should run, and find what runs."""
        text = self._store.get_fleet()
        self._record = Record.from_json(text) if text else self._record
        self._adopt()
        self._turn()
        self._trouble = None
        self._begun.set()
        if (registry := self._registry) is not None:
            # Not before: a client would take an empty answer for the end of its stream.
            self._start_thread(lambda: self._serve(registry))

    def _serve(self, registry: RegistryServer) -> None:
        """Answer the registry, without the store."""
        while not self._over.is_set():
            registry.turn(_QUESTION_SECONDS)

    def _run(self) -> None:
        while not self._over.wait(_TURN_SECONDS):
            try:
                if self._begun.is_set():
                    self._turn()
                else:  # Ray has started it again while the store cannot be reached
                    self._begin()
            except Exception as error:  # the next turn may succeed; the streams do not need the controller
                if repr(error) != self._logged:  # once, not twice a second
                    _log.exception("A turn of the controller failed.")
                self._logged = repr(error)

    def _turn(self) -> None:
        """Look at the cluster and the actors, and do what the table says."""
        found, existing = nodes(), self._existing()  # without the lock: they ask the head
        with self._lock:
            draining = self._record.draining
            self._nodes = [replace(node, draining=node.name in draining) for node in found]
            self._read_clients()
            names = set() if self._closing else self._record.spec.streams.keys() - self._ended.keys()
            for name in sorted(names | self._actors.keys()):
                self._observe(name, exists=name in existing)
                self._step(name, self._record.wanted(name) if name in names else None)
        self._recent = self.status()

    def _existing(self) -> set[str]:
        """The streams that have an actor."""
        from ray.util import list_named_actors

        prefix = actor_name(self._name, "stream") + "/"
        entries = (entry for entry in list_named_actors(all_namespaces=True) if entry["namespace"] == NAMESPACE)
        return {entry["name"].removeprefix(prefix) for entry in entries if entry["name"].startswith(prefix)}

    def _adopt(self) -> None:
        """Find the actors that an earlier controller has started."""
        import ray

        for name in self._existing():
            with suppress(ValueError):  # it has died meanwhile
                handle = ray.get_actor(actor_name(self._name, "stream", name), namespace=NAMESPACE)
                self._actors[name] = _Actor(handle, Seen("pending", time.monotonic(), time.monotonic()))

    def _observe(self, name: str, *, exists: bool) -> None:
        """Take the answer of an actor, if it has arrived, and ask for the next one."""
        import ray
        from ray.exceptions import RayError

        actor = self._actors.get(name)
        if actor is None:
            return
        actor.seen = replace(actor.seen, happened="" if exists else "gone")
        if not exists:
            return
        if actor.call is not None and ray.wait([actor.call], timeout=0)[0]:
            call, actor.call = actor.call, None
            try:
                answer = ray.get(call)
                if isinstance(answer, Report):
                    self._take(name, actor, answer)
                else:  # it has stopped
                    ray.kill(actor.handle)
            except RayError as error:
                _log.warning("%s is interrupted: %s", name, str(error).partition("\n")[0])
                actor.seen = replace(actor.seen, happened="interrupted", node="")
        if actor.call is None:
            follow = self._record.spec.streams[name].follow if name in self._record.spec.streams else ()
            actor.call = actor.handle.report.remote(self._clients, follow)

    def _take(self, name: str, actor: _Actor, report: Report) -> None:
        """Keep a report."""
        actor.report, self._last[name] = report, report.status
        happened: life.Event = "reports"
        if report.superseded:
            happened = "superseded"
        elif report.status.state == "ended":
            happened, self._ended[name] = "ended", report.order.digest
        if report.status.state == "running":
            self._pauses.pop(name, None)
        actor.seen = replace(
            actor.seen, happened=happened, answered=time.monotonic(), order=report.order, node=report.status.node
        )

    def _step(self, name: str, wanted: Wanted | None) -> None:
        """Do what the table says."""
        now = time.monotonic()
        if (actor := self._actors.get(name)) is None and name in self._pauses and now < self._pauses[name].until:
            return
        happened = life.event(wanted, actor.seen if actor is not None else None, self._nodes, now)
        state = actor.seen.state if actor is not None else "absent"
        if happened is None or (state, happened) not in life.TABLE:
            return
        after, action = life.TABLE[state, happened]
        if action or after != state:
            _log.info("%s: %s, %s: %s%s", name, state, life.EVENTS[happened], after, f", {action}" if action else "")
        if after == "absent":
            del self._actors[name]
            if state != "stopping":
                self._pause(name, now)
        elif actor is not None:
            self._act(actor, action)
            changed = now if after != state or action == "kill" else actor.seen.since
            actor.seen = replace(actor.seen, state=after, since=changed, answered=max(actor.seen.answered, changed))
        elif wanted is not None:
            self._start(name, wanted, now)
        if happened == "superseded":
            self._pause(name, now)
        if happened in ("interrupted", "silent", "superseded") and state != "stopping":
            self._restarts[name] = self._restarts.get(name, 0) + 1

    def _act(self, actor: _Actor, action: life.Action) -> None:
        import ray

        match action:
            case "stop":
                actor.call = actor.handle.stop.remote()
            case "restart":
                ray.kill(actor.handle, no_restart=False)
            case "kill":
                ray.kill(actor.handle)

    def _pause(self, name: str, now: float) -> None:
        """Begin the pause before the next start of an actor that is gone."""
        before = self._pauses.get(name)
        seconds = min(2 * before.seconds, _LONGEST_PAUSE) if before is not None else _FIRST_PAUSE
        self._pauses[name] = _Pause(now + seconds, seconds)

    def _start(self, name: str, wanted: Wanted, now: float) -> None:
        """Ask Ray to run a stream."""
        import ray

        spec, order = self._record.spec, wanted.order(self._nodes)
        options: dict[str, Any] = {"label_selector": order.selector} if order.selector else {}
        try:
            handle = (
                ray.remote(StreamActor)
                .options(
                    name=actor_name(self._name, "stream", name),
                    namespace=NAMESPACE,
                    lifetime="detached",
                    num_cpus=order.cores,
                    max_restarts=-1,
                    max_concurrency=4,
                    **options,
                )
                .remote(spec.streams[name], order, self._clients, spec.store, spec.every)
            )
        except ValueError:  # the name is taken: the actor before it is not quite gone
            return
        self._actors[name] = _Actor(handle, Seen("pending", now, now, order))

    def _read_clients(self) -> None:
        """Read which clients may connect; the next reports tell the streams."""
        if self._keys is not None and time.monotonic() >= self._clients_due:
            self._clients_due = time.monotonic() + _CLIENTS_SECONDS
            self._clients = allowed(self._keys)

    # What is shown.

    def _stream_status(self, name: str) -> StreamStatus:
        spec, actor = self._record.spec.streams[name], self._actors.get(name)
        known = self._last.get(name, StreamStatus(name, "starting", source=without_password(spec.source)))
        known = replace(known, restarts=known.restarts + self._restarts.get(name, 0))
        if actor is not None and actor.report is not None and actor.seen.state == "working":
            return replace(known, node=self._node_name(actor.seen.node))
        known = replace(known, node="", endpoint="", server="", rate=0.0)
        if name in self._ended:
            return replace(known, state="ended", trouble="")
        if actor is not None and actor.seen.state == "stopping":
            return replace(known, state="moving", node=self._node_name(actor.seen.node), trouble="")
        if trouble := self._waits_for(name):
            return replace(known, state="unplaced", trouble=trouble)
        return replace(known, state="starting", trouble="")

    def _waits_for(self, name: str) -> str:
        """What a stream that Ray has not placed waits for; empty if there is room for it."""
        wanted = self._record.wanted(name)
        if reason := life.objection(name, wanted, self._nodes):
            return reason
        fitting = [node for node in self._nodes if node.alive and wanted.fits(node)]
        free = max(node.cores - self._used(node) for node in fitting)
        if free + 1e-6 >= wanted.cores:
            return ""
        return f"{name} waits for {wanted.cores:g} free cores: no node that it may run on has more than {free:.2g}"

    def _used(self, node: Node) -> float:
        """The cores that Ray has reserved for streams on a node."""
        here = (actor.seen for actor in self._actors.values() if actor.seen.node == node.id)
        return sum(seen.order.cores for seen in here if seen.order is not None)

    def _node_name(self, id_: str) -> str:
        return next((node.name for node in self._nodes if node.id == id_), "")

    def _node_statuses(self, streams: dict[str, StreamStatus]) -> dict[str, NodeStatus]:
        statuses = {}
        for node in self._nodes:
            state: NodeState = "dead" if not node.alive else "draining" if node.draining else "alive"
            here = [each for each in streams.values() if each.node == node.name]
            slow = sum("it skips" in each.trouble for each in here)
            trouble = f"{slow} of its streams skip frames" if slow else ""
            used = self._used(node) if node.alive else 0.0
            statuses[node.name] = NodeStatus(
                node.name, state, node.address, node.cores, used, dict(node.labels), len(here), trouble
            )
        return statuses

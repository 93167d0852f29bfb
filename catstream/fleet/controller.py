"""The controller of a fleet: a Ray actor that reconciles the running actors with the desired streams.

The desired streams are in the store, and actors are named, so a controller that Ray restarts finds both, and does not
touch running streams. Ray schedules a stream, and restarts it elsewhere if its process or its node dies. One thread
reconciles the actors twice a second, and answers the registry in between; calls from `catstream.fleet.fleet` are
executed in threads of Ray. Only these calls use the store, so a store that hangs delays only the change that waits for
it. A change is stored before it is answered.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from catstream.base.addresses import is_live, without_password
from catstream.base.system import die_with
from catstream.errors import CatstreamError
from catstream.fleet.actor import Stream
from catstream.fleet.registry import RegistryServer
from catstream.fleet.spec import FleetSpec, StreamSpec, from_json, to_json
from catstream.fleet.store import Store
from catstream.wire.keys import Client, clients, ensure
from catstream.wire.messages import FleetStatus, NodeStatus, StreamStatus

#: Namespace of the named actors of all fleets.
NAMESPACE = "catstream"
#: Contents of saved models, by stream and object.
Models = dict[tuple[str, str], bytes]

_RECONCILE_SECONDS = 0.5  # interval between two comparisons of actors and desired streams
_WAIT_SECONDS = 0.1  # timeout for the reports of all streams, and for a question to the registry
_GOODBYE_SECONDS = 2.0  # time for clients, which ask every second, to learn that all streams have ended
_PAUSE_SECONDS = 5.0  # minimum interval between two starts of an actor, which may die or be superseded each time
SILENT_SECONDS = 120.0  # timeout for an answer, after which a stream is restarted; long, as the machine may be busy
STOPPING_SECONDS = 30.0  # timeout for a stream to store its last state and to end, after which it is killed
QUIET_SECONDS = 5.0  # time without an answer of a stream after which the status reports it
PLACED_SECONDS = 15.0  # time for Ray to schedule and start a stream, after which the status reports a delay

_log = logging.getLogger(__name__)


class StreamActor(Stream):
    """A stream as a Ray actor, with the node and address where Ray has scheduled it."""

    def __init__(self, spec: StreamSpec, clients: dict[str, Client] | None, store: str, every: float) -> None:
        import ray

        die_with(os.getppid())  # Ray's raylet, which supervises the stream
        node = ray.get_runtime_context().get_node_id()
        address = "" if clients is None else ray.util.get_node_ip_address()
        super().__init__(spec, node, address, clients or {}, store, every)


@dataclass(slots=True)
class Actor:
    """The controller's record of the actor of a stream.

    handle    Ray's handle; None if there is no actor
    order     `StreamSpec.order` at its start, a part of its name
    started   time of its last start
    since     time at which Ray began to schedule it, or at which it was stopped
    answered  time of its last answer
    node      id of the node in its last report; "" while Ray schedules and starts it
    status    last report; None before the first one
    stops     whether it is being stopped or was killed
    ended     `StreamSpec.digest` of the stream whose source has ended; "" if it has not
    call      pending call for a report or to stop it
    """

    handle: Any = None
    order: str = ""
    started: float = float("-inf")
    since: float = 0.0
    answered: float = 0.0
    node: str = ""
    status: StreamStatus | None = None
    stops: bool = False
    ended: str = ""
    call: Any = None


class Controller:
    """An actor of each fleet; `catstream.fleet.fleet` calls its public methods.

    listen  tcp://HOST:PORT at which the registry listens, or the folder of its Unix socket
    keys    folder of the keys of the clients; empty if all clients are on this machine
    """

    def __init__(self, name: str, store: str, listen: str, keys: str) -> None:
        die_with(os.getppid())  # Ray's raylet: an orphan would keep the address of the registry
        self._name, self._listen, self._store = name, listen, Store(store)
        self._keys = Path(keys).expanduser() if keys else None
        self._spec = FleetSpec(name, store)
        self._trouble: CatstreamError | None = None  # error of `_begin`
        self._changing = threading.Lock()  # locked while a change is stored
        self._lock = threading.RLock()  # for the following attributes, locked only briefly
        self._nodes: list[dict[str, Any]] = []  # in Ray's format
        self._actors: dict[str, Actor] = {}
        self._clients: dict[str, Client] | None = None if self._keys is None else {}
        self._phase: Literal["idle", "up", "down"] = "idle"  # idle before the first change, down while the fleet ends
        self._unstored: dict[str, str] = {}  # errors of storing the last state of stopped streams
        self._last_question = float("-inf")  # time of the last question to the registry
        self._over = threading.Event()
        self._registry: RegistryServer | None = None
        try:
            self._begin()
        except CatstreamError as error:
            self._trouble = error
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def ready(self) -> None:
        """Raise CatstreamError if its address is in use, or its store cannot be read."""
        if self._trouble is not None:
            raise self._trouble

    def apply(self, spec: FleetSpec, models: Models) -> list[str]:
        """Set the desired streams; returns a line for each stream with its change."""
        return self._change(lambda _: spec, models)

    def add(self, stream: StreamSpec, models: Models) -> list[str]:
        return self._change(lambda spec: replace(spec, streams=spec.streams | {stream.name: stream}), models)

    def remove(self, names: tuple[str, ...]) -> list[str]:
        """Remove streams, but not their states."""
        return self._change(lambda spec: replace(spec, streams=spec.without(names)))

    def status(self) -> FleetStatus:
        with self._lock:
            streams = {name: self._stream_status(name) for name in sorted(self._spec.streams)}
            return FleetStatus(self._name, time.time(), streams, self._node_states())

    def spec(self) -> FleetSpec:
        return self._spec

    def close(self) -> list[str]:
        """Stop all streams after storing their states; returns the names of the streams that are still running."""
        self._phase = "down"
        return sorted(name for name, actor in self._actors.items() if actor.handle is not None)

    def end(self) -> list[str]:
        """End the thread and the registry; returns a line for each stream whose last state was not stored."""
        self._spec = replace(self._spec, streams={})
        if time.monotonic() - self._last_question < _GOODBYE_SECONDS:
            time.sleep(_GOODBYE_SECONDS)
        self._over.set()
        self._thread.join()
        if self._registry is not None:
            self._registry.close()
        return [f"{name}: {trouble}" for name, trouble in sorted(self._unstored.items()) if trouble]

    def _change(self, change: Callable[[FleetSpec], FleetSpec], models: Models | None = None) -> list[str]:
        """Store a change of the desired state, then apply it."""
        with self._changing:
            self.ready()
            spec = change(self._spec)
            spec.check_follows(self._spec)
            for (stream, name), data in (models or {}).items():
                self._store.model(stream, name).put({"model": data}, {})
            self._store.fleet.put({"fleet": to_json(spec)}, {})
            with self._lock:
                ended = {name for name, actor in self._actors.items() if actor.ended}
                lines = self._spec.changes(spec, ended, are_running=self._phase == "up")
                self._spec, self._phase = spec, "up"
                for name in self._actors.keys() - spec.streams.keys():  # not for a new stream with the same name
                    self._actors[name].status, self._actors[name].ended = None, ""
            return lines

    def _begin(self) -> None:
        """Open the registry, read the desired streams, and find the running actors."""
        import ray

        if self._registry is None:
            if self._keys is not None:
                ensure(self._keys)
            self._registry = RegistryServer(self._listen, str(self._keys or ""), self.status)
        if (stored := self._store.fleet.newest()) is not None:
            self._spec = from_json(stored.files["fleet"])
        if ray.get_runtime_context().was_current_actor_reconstructed:  # by Ray, while the fleet ran
            self._phase = "up"
        self._reconcile()
        self._trouble = None

    def _run(self) -> None:
        logged, deadline = "", time.monotonic() + _RECONCILE_SECONDS
        while not self._over.is_set():
            if self._registry is None or self._trouble is not None:
                self._over.wait(_RECONCILE_SECONDS)  # an empty answer would mean the end of a client's stream
            elif self._registry.serve(_WAIT_SECONDS):
                self._last_question = time.monotonic()
            if time.monotonic() < deadline:
                continue
            deadline = time.monotonic() + _RECONCILE_SECONDS
            try:
                if self._trouble is None:
                    self._reconcile()
                else:  # Ray has restarted the controller while the store is unreachable
                    self._begin()
            except Exception as error:  # the next iteration may succeed; streams do not depend on the controller
                if repr(error) != logged:  # once, not twice a second
                    _log.exception("An iteration of the controller failed.")
                logged = repr(error)

    def _reconcile(self) -> None:
        """Compare the actors with the desired streams, and start, stop, restart or kill them."""
        import ray

        # Step 1: request a report from each actor.
        cluster, existing = nodes(), actors(self._name)  # without the lock, because they query the head
        with self._lock:
            self._nodes = cluster
            if self._keys is not None:
                self._clients = clients(self._keys)  # passed to the streams with the next requests
            for name in existing.keys() | self._spec.streams.keys() | self._actors.keys():
                self._request_report(name, self._actors.setdefault(name, Actor()), existing.get(name))
            calls = [actor.call for actor in self._actors.values() if actor.call is not None]
        if calls:  # a running stream answers at once
            ray.wait(calls, num_returns=len(calls), timeout=_WAIT_SECONDS)
        # Step 2: receive the answers, and reconcile each actor.
        with self._lock:
            for name, actor in sorted(self._actors.items()):
                is_superseded = self._receive_answer(name, actor)
                if self._phase != "idle":
                    self._reconcile_actor(name, actor, is_superseded=is_superseded)
            for name in self._actors.keys() - self._spec.streams.keys():
                if self._actors[name].handle is None:
                    del self._actors[name]

    def _desired(self, name: str) -> StreamSpec | None:
        """The spec of a stream; None if it should not be running."""
        spec = self._spec.streams.get(name) if self._phase == "up" else None
        return None if spec is None or self._actors[name].ended == spec.digest else spec

    def _request_report(self, name: str, actor: Actor, order: str | None) -> None:
        """Request a report from an actor, unless a call is pending; `order` is None if the actor has ended."""
        import ray

        if order is None:
            actor.handle = actor.call = None
            actor.node, actor.stops = "", False
            return
        if actor.handle is None:  # an earlier controller has started it
            with suppress(ValueError):  # it has just died
                actor.handle = ray.get_actor(actor_name(self._name, "stream", name, order), namespace=NAMESPACE)
                actor.order, actor.since = order, time.monotonic()
        if actor.handle is not None and actor.call is None:
            actor.call = actor.handle.report.remote(self._clients)

    def _receive_answer(self, name: str, actor: Actor) -> bool:
        """Process the answer of an actor, if it has arrived; returns True if the actor is superseded."""
        import ray
        from ray.exceptions import RayError

        if actor.call is None or not ray.wait([actor.call], timeout=0)[0]:
            return False
        call, actor.call = actor.call, None
        try:
            answer = ray.get(call)
        except RayError as error:  # its process or its node died: Ray schedules it again
            if actor.node:
                _log.warning("%s is interrupted: %s", name, str(error).partition("\n")[0])
                actor.node, actor.since = "", time.monotonic()
            return False
        if isinstance(answer, str):  # it has stopped
            if self._phase == "down":
                self._unstored[name] = answer
            ray.kill(actor.handle)
            return False
        actor.status, is_superseded = answer
        actor.answered, actor.node = time.monotonic(), actor.status.node
        if actor.status.state == "ended":
            actor.ended = actor.order.partition("/")[0]
        return bool(is_superseded)

    def _reconcile_actor(self, name: str, actor: Actor, *, is_superseded: bool) -> None:
        """Start, stop, restart or kill an actor if it differs from the desired stream."""
        import ray

        spec, now = self._desired(name), time.monotonic()
        if actor.handle is None:
            if spec is not None and now - actor.started >= _PAUSE_SECONDS:
                self._start(spec, actor, now)
        elif actor.stops:
            if now - actor.since > STOPPING_SECONDS:
                ray.kill(actor.handle)
                actor.since = now
        elif is_superseded or spec is None or spec.order != actor.order:
            if is_superseded or not actor.node:  # it must not store its state, or is not running yet
                ray.kill(actor.handle)
            else:
                actor.call = actor.handle.stop.remote()
            actor.stops, actor.since = True, now
        elif actor.node and now - actor.answered > SILENT_SECONDS:
            ray.kill(actor.handle, no_restart=False)
            actor.node, actor.since = "", now

    def _start(self, spec: StreamSpec, actor: Actor, now: float) -> None:
        import ray

        with suppress(ValueError):  # the name is in use: the previous actor is still ending
            actor.handle = (
                ray.remote(StreamActor)
                .options(
                    name=actor_name(self._name, "stream", spec.name, spec.order),
                    namespace=NAMESPACE,
                    lifetime="detached",
                    num_cpus=spec.cores,
                    max_restarts=-1,
                    max_concurrency=4,
                    label_selector=dict(spec.labels) or None,
                    scheduling_strategy="SPREAD",
                )
                .remote(spec, self._clients, self._spec.store, self._spec.every)
            )
            actor.order, actor.ended = spec.order, ""
            actor.since = actor.started = now

    def _stream_status(self, name: str) -> StreamStatus:
        spec, actor, now = self._spec.streams[name], self._actors.setdefault(name, Actor()), time.monotonic()
        source = without_password(spec.source)
        last = actor.status or StreamStatus(name, "starting", source=source, live=is_live(spec.source))
        if actor.node and not actor.stops:
            node = next((node["NodeName"] for node in self._nodes if node["NodeID"] == actor.node), "")
            quiet = now - actor.answered
            trouble = f"it has not answered for {quiet:.0f} s" if quiet > QUIET_SECONDS else last.trouble
            leaves = self._phase == "up" and actor.order != spec.order
            return replace(last, node=node, state="moving" if leaves else last.state, trouble=trouble)
        age = None if last.stored_seconds is None else last.stored_seconds + now - actor.answered
        last = replace(
            last, state="starting", node="", endpoint="", server="", stored_seconds=age, trouble="", present={}
        )
        if actor.ended == spec.digest:
            return replace(last, state="ended")
        if self._phase == "down":
            return replace(last, state="stopping")
        if actor.stops:
            return replace(last, state="moving")
        waited = now - actor.since
        if actor.handle is not None and waited > PLACED_SECONDS:
            return replace(last, trouble=f"Ray has not started it for {waited:.0f} s: see its demands in `ray status`")
        return last

    def _node_states(self) -> dict[str, NodeStatus]:
        """The nodes by name; a dead node is replaced by a living one with the same name."""
        states: dict[str, NodeStatus] = {}
        for node in sorted(self._nodes, key=lambda node: (node["NodeName"], node["Alive"])):
            specs = [spec for name, spec in self._spec.streams.items() if self._actors[name].node == node["NodeID"]]
            states[node["NodeName"]] = NodeStatus(
                node["NodeName"],
                "alive" if node["Alive"] else "dead",
                node["NodeManagerAddress"],
                float(node["Resources"].get("CPU", 0.0)),
                sum(spec.cores for spec in specs),
                {key: value for key, value in (node.get("Labels") or {}).items() if not key.startswith("ray.io/")},
                len(specs),
            )
        return states


def actor_name(fleet: str, *words: str) -> str:
    """The name of an actor: site/controller, or site/stream/cam-7/ORDER."""
    return "/".join((fleet, *words))


def named_actors() -> list[str]:
    from ray.util import list_named_actors

    return [actor["name"] for actor in list_named_actors(all_namespaces=True) if actor["namespace"] == NAMESPACE]


def actors(fleet: str) -> dict[str, str]:
    """The `StreamSpec.order` of the actor of each stream of a fleet, by stream."""
    prefix = actor_name(fleet, "stream") + "/"
    parts = (name.removeprefix(prefix).partition("/") for name in named_actors() if name.startswith(prefix))
    return {stream: order for stream, _, order in parts}


def nodes() -> list[dict[str, Any]]:
    """The nodes of the connected cluster in Ray's format; the default name is the address."""
    import ray

    return [node | {"NodeName": node["NodeName"] or node["NodeManagerAddress"]} for node in ray.nodes()]

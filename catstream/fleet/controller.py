"""The controller of a fleet: an actor of Ray that compares the streams that should run with the actors that do.

What should run is in the store, and the streams are actors with names, so a controller that Ray starts again finds
both, and touches no stream that runs. `catstream.fleet.lifecycle` decides what is done, this class only does it. Three
kinds of threads share its state: one looks at the actors twice a second, one answers the registry, and calls of
`catstream.fleet.fleet` come in threads of Ray. Only the last ones use the store, so a store that hangs delays nothing
but the change that waits for it. What is answered as done is stored.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

from catstream.base.addresses import is_live, without_password
from catstream.errors import CatstreamError
from catstream.fleet import lifecycle
from catstream.fleet.actor import Stream
from catstream.fleet.lifecycle import Actor, Node
from catstream.fleet.registry import RegistryServer
from catstream.fleet.spec import FleetSpec, StreamSpec, from_json, to_json
from catstream.fleet.store import Store
from catstream.messages.kinds import FleetStatus, NodeState, NodeStatus, StreamStatus
from catstream.wire.keys import Client, clients, ensure

#: Namespace of the named actors of all fleets.
NAMESPACE = "catstream"
#: Contents of saved models, by stream and object.
Models = dict[tuple[str, str], bytes]

_TURN_SECONDS = 0.5  # between two looks at the actors
_REPORT_SECONDS = 0.1  # longest wait of a look for the reports of all streams
_QUESTION_SECONDS = 0.1  # longest wait for a question to the registry
_GOODBYE_SECONDS = 2.0  # for clients, which ask every second, to learn that there is no stream any more
_CLIENTS_SECONDS = 5.0  # between two looks at the keys of the clients
QUIET_SECONDS = 5.0  # without an answer of a stream, after which the status says so
PLACED_SECONDS = 15.0  # for Ray to place and start a stream, after which the status says that it has not

_log = logging.getLogger(__name__)


class StreamActor(Stream):
    """A stream as an actor of Ray, which tells the stream where it was placed."""

    def __init__(self, spec: StreamSpec, clients: dict[str, Client] | None, store: str, every: float) -> None:
        import ray

        node = ray.get_runtime_context().get_node_id()
        address = "" if clients is None else ray.util.get_node_ip_address()
        super().__init__(spec, node, address, clients or {}, store, every)


class Controller:
    """Runs as one actor of a fleet; the methods without an underscore are called by `catstream.fleet.fleet`.

    listen  tcp://HOST:PORT at which the registry listens, or the folder of its Unix socket
    keys    folder of the keys of the clients; empty if all are on this machine
    """

    def __init__(self, name: str, store: str, listen: str, keys: str) -> None:
        self._name, self._listen, self._store = name, listen, Store(store)
        self._keys = Path(keys).expanduser() if keys else None
        self._spec = FleetSpec(name, store)
        self._trouble: CatstreamError | None = None  # why it has not begun
        self._changing = threading.Lock()  # held by a change while it is stored
        self._lock = threading.RLock()  # of what follows, held for moments only
        self._nodes: list[Node] = []
        self._actors: dict[str, Actor] = {}
        self._clients: dict[str, Client] | None = None if self._keys is None else {}
        self._clients_due = 0.0
        self._phase: Literal["idle", "up", "down"] = "idle"  # before the first change; and while the fleet ends
        self._recent = FleetStatus(name, time.time())
        self._unstored: dict[str, str] = {}  # why the last state of a stream that has stopped is not stored
        self._last_question = float("-inf")  # when a client of the registry has asked last
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []
        self._registry: RegistryServer | None = None
        try:
            self._begin()
        except CatstreamError as error:
            self._trouble = error
        self._start_thread(self._run)

    def ready(self) -> None:
        """Return if it has begun; raise CatstreamError if its address is in use, or its store cannot be read."""
        if self._trouble is not None:
            raise self._trouble

    def apply(self, spec: FleetSpec, models: Models) -> list[str]:
        """Let these streams run, and no others; returns what will be done, a line for each stream."""
        return self._change(lambda _: spec, models)

    def add(self, stream: StreamSpec, models: Models) -> list[str]:
        return self._change(lambda before: replace(before, streams=before.streams | {stream.name: stream}), models)

    def remove(self, names: tuple[str, ...]) -> list[str]:
        """Remove streams; their states stay."""

        def changed(before: FleetSpec) -> FleetSpec:
            for name in names:
                before.check_stream(name)
            streams = {name: stream for name, stream in before.streams.items() if name not in names}
            return replace(before, streams=streams)

        return self._change(changed)

    def status(self) -> FleetStatus:
        with self._lock:
            streams = {name: self._stream_status(name) for name in sorted(self._spec.streams)}
            nodes = {node.name: self._node_status(node) for node in self._nodes}
            return FleetStatus(self._name, time.time(), streams, nodes)

    def spec(self) -> FleetSpec:
        return self._spec

    def close(self) -> list[str]:
        """Stop all streams after their state was stored; returns those that still run."""
        self._phase = "down"
        return sorted(name for name, actor in self._actors.items() if actor.handle is not None)

    def end(self) -> list[str]:
        """End the threads and the registry; returns a line for each stream whose last state is not in the store."""
        with self._lock:
            self._spec = replace(self._spec, streams={})
            self._recent = self.status()
        if time.monotonic() - self._last_question < _GOODBYE_SECONDS:
            time.sleep(_GOODBYE_SECONDS)
        self._over.set()
        for thread in self._threads:
            thread.join()
        if self._registry is not None:
            self._registry.close()
        return [f"{name}: {trouble}" for name, trouble in sorted(self._unstored.items()) if trouble]

    def _change(self, change: Callable[[FleetSpec], FleetSpec], models: Models | None = None) -> list[str]:
        """Change the desired state, once that is stored."""
        with self._changing:
            self.ready()
            spec = change(self._spec)
            spec.check_follows(self._spec)
            for (stream, name), data in (models or {}).items():
                self._store.model(stream, name).put({"model": data}, {})
            self._store.fleet.put({"fleet": to_json(spec)}, {})
            with self._lock:
                lines = self._spec.changes(spec, self._ended, are_running=self._phase == "up")
                self._spec, self._phase = spec, "up"
                for name in self._actors.keys() - spec.streams.keys():  # it would be taken for the next one of its name
                    self._actors[name].status, self._actors[name].ended = None, ""
                self._recent = self.status()
            return lines

    def _begin(self) -> None:
        """Open the registry, read what should run, and find what runs."""
        import ray

        if self._registry is None:
            if self._keys is not None:
                ensure(self._keys)
            self._registry = RegistryServer(self._listen, str(self._keys or ""), lambda: self._recent)
        if (stored := self._store.fleet.newest()) is not None:
            self._spec = from_json(stored.files["fleet"])
        if ray.get_runtime_context().was_current_actor_reconstructed:  # by Ray, while the fleet ran
            self._phase = "up"
        self._turn()
        self._trouble = None
        self._start_thread(self._serve)  # not before: a client would take an empty answer for the end of its stream

    def _start_thread(self, task: Callable[[], None]) -> None:
        self._threads.append(threading.Thread(target=task, daemon=True))
        self._threads[-1].start()

    def _serve(self) -> None:
        """Answer the registry, without the store."""
        while self._registry is not None and not self._over.is_set():
            if self._registry.turn(_QUESTION_SECONDS):
                self._last_question = time.monotonic()

    def _run(self) -> None:
        logged = ""
        while not self._over.wait(_TURN_SECONDS):
            try:
                if self._trouble is None:
                    self._turn()
                else:  # Ray has started it again while the store cannot be reached
                    self._begin()
            except Exception as error:  # the next turn may succeed; the streams do not need the controller
                if repr(error) != logged:  # once, not twice a second
                    _log.exception("A turn of the controller failed.")
                logged = repr(error)

    def _turn(self) -> None:
        """Look at the cluster and the actors, and do what makes them those that should run."""
        import ray

        cluster, existing = nodes(), actors(self._name)  # without the lock: they ask the head
        with self._lock:
            self._nodes = cluster
            if self._keys is not None and time.monotonic() >= self._clients_due:
                self._clients_due = time.monotonic() + _CLIENTS_SECONDS
                self._clients = clients(self._keys)  # the next reports tell the streams
            for name in sorted(existing.keys() | self._spec.streams.keys()):
                self._actors.setdefault(name, Actor())
            for name, actor in self._actors.items():
                self._ask(name, actor, existing.get(name))
            calls = [actor.call for actor in self._actors.values() if actor.call is not None]
        if calls:  # a stream that runs answers at once
            ray.wait(calls, num_returns=len(calls), timeout=_REPORT_SECONDS)
        with self._lock:
            for name, actor in self._actors.items():
                self._hear(name, actor)
                if self._phase != "idle":
                    self._step(name, actor)
            for name in self._actors.keys() - self._spec.streams.keys():
                if self._actors[name].state == "absent":
                    del self._actors[name]
            self._recent = self.status()

    def _desired(self, name: str) -> StreamSpec | None:
        """The spec of a stream; None if it should not run now."""
        spec = self._spec.streams.get(name) if self._phase == "up" else None
        return None if spec is None or self._ended.get(name) == spec.digest else spec

    @property
    def _ended(self) -> dict[str, str]:
        """The digests with which sources have ended, by stream."""
        return {name: actor.ended for name, actor in self._actors.items() if actor.ended}

    def _ask(self, name: str, actor: Actor, order: str | None) -> None:
        """Ask the actor of a stream for a report, unless it has still to answer; `order` is None if it has ended."""
        import ray

        actor.happened = "gone" if order is None else ""
        if order is None:
            return
        if actor.handle is None:  # an earlier controller has started it
            try:
                actor.handle = ray.get_actor(actor_name(self._name, "stream", name, order), namespace=NAMESPACE)
            except ValueError:  # it has died meanwhile
                return
            now = time.monotonic()
            actor.state, actor.order, actor.since, actor.answered = "pending", order, now, now
        if actor.call is None:
            actor.call = actor.handle.report.remote(self._clients)

    def _hear(self, name: str, actor: Actor) -> None:
        """Take the answer of the actor of a stream, if it has arrived."""
        import ray
        from ray.exceptions import RayError

        if actor.call is None or not ray.wait([actor.call], timeout=0)[0]:
            return
        call, actor.call = actor.call, None
        try:
            answer = ray.get(call)
        except RayError as error:
            _log.warning("%s is interrupted: %s", name, str(error).partition("\n")[0])
            actor.happened, actor.node = "interrupted", ""
            return
        if isinstance(answer, str):  # it has stopped
            if self._phase == "down":
                self._unstored[name] = answer
            ray.kill(actor.handle)
            return
        actor.status, is_superseded = answer
        actor.answered, actor.node, actor.happened = time.monotonic(), actor.status.node, "reports"
        if is_superseded:
            actor.happened = "superseded"
        elif actor.status.state == "ended":
            actor.happened, actor.ended = "ended", actor.order.partition("/")[0]

    def _step(self, name: str, actor: Actor) -> None:
        """Do what the table says for what has happened to a stream."""
        import ray

        spec, now, before = self._desired(name), time.monotonic(), actor.state
        happened = lifecycle.event(spec, actor, now)
        if happened is None or (step := lifecycle.TABLE.get((before, happened))) is None:
            return
        after, action = step
        _log.info("%s: %s, %s: %s %s", name, before, happened, after, action)
        match action:
            case "start" if spec is not None:
                self._start(spec, actor, now)
                return
            case "stop":
                actor.call = actor.handle.stop.remote()
            case "restart":
                ray.kill(actor.handle, no_restart=False)
            case "kill":
                ray.kill(actor.handle)
        actor.state = after
        if after == "absent":
            actor.handle = actor.call = None
            actor.node = ""
        elif after != before or action:
            actor.since = actor.answered = now

    def _start(self, spec: StreamSpec, actor: Actor, now: float) -> None:
        import ray

        with suppress(ValueError):  # the name is taken: the actor before it is not quite gone
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
            actor.state, actor.order, actor.ended = "pending", spec.order, ""
            actor.since = actor.started = actor.answered = now

    def _stream_status(self, name: str) -> StreamStatus:
        spec, actor, now = self._spec.streams[name], self._actors.get(name, Actor()), time.monotonic()
        source = without_password(spec.source)
        last = actor.status or StreamStatus(name, "starting", source=source, live=is_live(spec.source))
        if actor.state == "working":
            node = next((node.name for node in self._nodes if node.id == actor.node), "")
            quiet = now - actor.answered
            trouble = f"it has not answered for {quiet:.0f} s" if quiet > QUIET_SECONDS else last.trouble
            leaves = self._phase == "up" and lifecycle.event(self._desired(name), actor, now) == "unwanted"
            return replace(last, node=node, state="moving" if leaves else last.state, trouble=trouble)
        age = None if last.stored_seconds is None else last.stored_seconds + now - actor.answered
        last = replace(last, state="starting", node="", endpoint="", server="", stored_seconds=age)
        last = replace(last, trouble="", present={})
        if actor.ended == spec.digest:
            return replace(last, state="ended")
        if self._phase == "down":
            return replace(last, state="stopping")
        if actor.state == "stopping":
            return replace(last, state="moving")
        waited = now - actor.since
        if actor.state == "pending" and waited > PLACED_SECONDS:
            return replace(last, trouble=f"Ray has not started it for {waited:.0f} s: `ray status` says what it needs")
        return last

    def _node_status(self, node: Node) -> NodeStatus:
        state: NodeState = "alive" if node.alive else "dead"
        working = (name for name, actor in self._actors.items() if actor.node == node.id and actor.state == "working")
        here = [name for name in working if name in self._spec.streams]
        used = sum(self._spec.streams[name].cores for name in here)
        return NodeStatus(node.name, state, node.address, node.cores, used, dict(node.labels), len(here))


def actor_name(fleet: str, *words: str) -> str:
    """The name of an actor: site/controller, or site/stream/cam-7/ and what it was started for."""
    return "/".join((fleet, *words))


def named_actors() -> list[str]:
    from ray.util import list_named_actors

    return [actor["name"] for actor in list_named_actors(all_namespaces=True) if actor["namespace"] == NAMESPACE]


def actors(fleet: str) -> dict[str, str]:
    """The specification for which the actor of each stream of a fleet was started, by stream."""
    prefix = actor_name(fleet, "stream") + "/"
    parts = (name.removeprefix(prefix).partition("/") for name in named_actors() if name.startswith(prefix))
    return {stream: order for stream, _, order in parts}


def nodes() -> list[Node]:
    """The nodes of the connected cluster by name; a dead one as long as no living node has its name."""
    import ray

    by_name: dict[str, Node] = {}
    for entry in ray.nodes():
        node = Node(
            entry["NodeName"] or entry["NodeManagerAddress"],
            entry["NodeID"],
            entry["NodeManagerAddress"],
            float(entry["Resources"].get("CPU", 0.0)),
            {key: value for key, value in (entry.get("Labels") or {}).items() if not key.startswith("ray.io/")},
            entry["Alive"],
        )
        if node.name not in by_name or node.alive:
            by_name[node.name] = node
    return sorted(by_name.values(), key=lambda node: node.name)

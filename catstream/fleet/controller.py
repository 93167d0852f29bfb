"""The controller of a fleet: an actor of Ray that compares the streams that should run with the actors that do.

What should run is in the store, and the streams are actors with names, so a controller that Ray starts again finds
both, and touches no stream that runs. `catstream.fleet.life` decides what is done, this class only does it. Three kinds
of threads share its state: one looks at the actors twice a second, one answers the registry, and calls of
`catstream.fleet.Fleet` come in threads of Ray. Only the last ones use the store, so a store that hangs delays nothing
but the change that waits for it. What is answered as done is stored.
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

from catstream.client.registry import RegistryServer
from catstream.errors import CatstreamError, FleetError
from catstream.fleet import life
from catstream.fleet.cluster import NAMESPACE, actor_name, actors, is_local, nodes
from catstream.fleet.desired import Desired, objection
from catstream.fleet.life import Node, Order, Seen, Step, Wanted
from catstream.fleet.spec import FleetSpec, StreamSpec, from_json, to_json
from catstream.fleet.store import Store
from catstream.fleet.stream import Place, Report, Stream, given_model
from catstream.fleet.timing import (
    CLIENTS_SECONDS,
    LOGS_SECONDS,
    QUESTION_SECONDS,
    QUIET_SECONDS,
    REPORT_SECONDS,
    TURN_SECONDS,
)
from catstream.messages.kinds import FleetStatus, NodeState, NodeStatus, StreamStatus
from catstream.services.start_server import start_server
from catstream.video.frames import without_password
from catstream.wire.keys import Client, allowed, ensure

#: Contents of saved models, by stream and object.
Models = dict[tuple[str, str], bytes]

_log = logging.getLogger(__name__)


def warm() -> None:
    """Start the start server of this process, so that a stream is quickly there whose node has died."""
    os.environ["OMP_NUM_THREADS"] = "1"  # Ray sets the cores of an actor: there would be a server for each number
    start_server()


class StreamActor(Stream):
    """A stream as an actor of Ray, which tells the stream where it was placed."""

    def __init__(self, spec: StreamSpec, order: Order, clients: dict[str, Client] | None, store: str, every: float):
        import ray

        warm()
        node = ray.get_runtime_context().get_node_id()
        address = "" if clients is None else ray.util.get_node_ip_address()
        super().__init__(spec, order, Place(node, address, clients or {}), store, every)


@dataclass(slots=True)
class _Known:
    """The controller's knowledge of a stream.

    seen      its actor
    handle    of Ray, if there is an actor
    call      the call for the next report, or that stops it, which was not answered yet
    report    its last report; None before the first one
    ended     digest with which its source has ended; empty if it has not
    started   moment at which its actor was started
    """

    seen: Seen
    handle: Any = None
    call: Any = None
    report: Report | None = None
    ended: str = ""
    started: float = float("-inf")


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
        self._name, self._listen, self._store = name, listen, Store(store)
        self._keys = None if is_local() else Path(keys).expanduser()
        self._desired = Desired(FleetSpec(name, store))
        self._trouble: CatstreamError | None = None  # why it has not begun
        self._changing = threading.Lock()  # held by a change while it is stored
        self._lock = threading.RLock()  # of what follows, held for moments only
        self._nodes: list[Node] = []
        self._streams: dict[str, _Known] = {}
        self._clients: dict[str, Client] | None = None if self._keys is None else {}
        self._clients_due = 0.0
        self._phase: Literal["idle", "up", "down"] = "idle"  # before the first change; and while the fleet ends
        self._recent = FleetStatus(name, time.time())
        self._unstored: dict[str, str] = {}  # why the last state of a stream that has stopped is not stored
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []
        self._registry: RegistryServer | None = None
        try:
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

    def change(
        self, how: str, *arguments: object, models: Models | None = None, may_wait: bool = False, **options: object
    ) -> list[str]:
        """Change the desired state by a method of `Desired`; returns what will be done, a line for each stream.

        Parameters
        ----------
        how : name of the method; its arguments and options follow
        models : contents of the saved models that streams name, by stream and object
        may_wait : whether streams may wait for nodes that join later

        Raises
        ------
        FleetError
            If the method refuses it, or not all streams can run. Nothing is changed then.
        StoreError
            If the change cannot be stored. Nothing is changed then.
        """
        with self._changing:
            self.ready()
            desired: Desired = getattr(self._desired, how)(*arguments, **options)
            if not may_wait:
                desired.check_fits(self._nodes, self._ended)
            for (stream, name), data in (models or {}).items():
                self._store.model(given_model(stream, name)).put({"model": data}, {})
            self._store.fleet.put({"fleet": to_json(desired)}, {})
            with self._lock:
                running = self._phase == "up"
                lines: list[str] = self._desired.spec.changes(desired.spec, self._ended, are_running=running)
                self._desired, self._phase = desired, "up"
                for name in self._streams.keys() - desired.spec.streams.keys():  # only the actor is left, until it ends
                    known = self._streams[name]
                    self._streams[name] = _Known(known.seen, known.handle, known.call)
                self._recent = self.status()
            return lines

    def status(self) -> FleetStatus:
        """The state of all streams and nodes."""
        with self._lock:
            streams = {name: self._stream_status(name) for name in sorted(self._desired.spec.streams)}
            states = {node.name: self._node_status(node, streams) for node in self._nodes}
            return FleetStatus(self._name, time.time(), streams, states)

    def spec(self) -> FleetSpec:
        """The desired streams."""
        return self._desired.spec

    def logs(self, name: str, lines: int) -> list[str]:
        """The last lines that a stream logged."""
        self._desired.check_stream(name)
        known = self._streams.get(name)
        if known is None or known.seen.state not in ("working", "stopping"):
            raise FleetError(f"{name} runs on no node now, so its log cannot be read: see catstream fleet status")
        import ray

        logged: list[str] = ray.get(known.handle.logs.remote(lines), timeout=LOGS_SECONDS)
        return logged

    def close(self) -> int:
        """Stop all streams after their state was stored; returns how many still run."""
        self._phase = "down"
        return sum(known.handle is not None for known in self._streams.values())

    def end(self) -> list[str]:
        """End the threads, and the registry; the streams run on.

        Returns
        -------
        a line for each stream that was stopped without its last state in the store
        """
        self._over.set()
        for thread in self._threads:
            thread.join()
        if self._registry is not None:
            self._registry.close()
        return [f"{name}: {trouble}" for name, trouble in sorted(self._unstored.items()) if trouble]

    # What it does.

    def _begin(self) -> None:
        """Open the registry, read what should run, and find what runs."""
        import ray

        if self._registry is None:
            if self._keys is not None:
                ensure(self._keys)
            self._registry = RegistryServer(self._listen, str(self._keys or ""), lambda: self._recent)
        if (stored := self._store.fleet.newest()) is not None:
            self._desired = from_json(stored.files["fleet"], Desired)
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
            self._registry.turn(QUESTION_SECONDS)

    def _run(self) -> None:
        logged = ""
        while not self._over.wait(TURN_SECONDS):
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

        found, existing = nodes(), actors(self._name)  # without the lock: they ask the head
        with self._lock:
            self._nodes = self._desired.with_draining(found)
            if self._keys is not None and time.monotonic() >= self._clients_due:
                self._clients_due = time.monotonic() + CLIENTS_SECONDS
                self._clients = allowed(self._keys)  # the next reports tell the streams
            for name in existing | self._desired.spec.streams.keys():
                self._streams.setdefault(name, _Known(Seen("absent")))
            for name, known in self._streams.items():
                self._ask(name, known, exists=name in existing)
            calls = [known.call for known in self._streams.values() if known.call is not None]
        if calls:  # a stream that runs answers at once
            ray.wait(calls, num_returns=len(calls), timeout=REPORT_SECONDS)
        with self._lock:
            for name, known in self._streams.items():
                self._hear(name, known)
            if self._phase != "idle":
                wanted, seen = self._wanted(), {name: known.seen for name, known in self._streams.items()}
                for name, step in life.diff(wanted, seen, self._nodes, time.monotonic()).items():
                    self._do(name, step, wanted.get(name))
            gone = [name for name, known in self._streams.items() if known.seen.state == "absent"]
            for name in set(gone) - self._desired.spec.streams.keys():
                del self._streams[name]
            self._recent = self.status()

    def _wanted(self) -> dict[str, Wanted]:
        """The streams that should run now."""
        if self._phase != "up":
            return {}
        return {name: each for name, each in self._desired.unended(self._ended).items() if name in self._streams}

    @property
    def _ended(self) -> dict[str, str]:
        """The digests with which sources have ended, by stream."""
        with self._lock:
            return {name: known.ended for name, known in self._streams.items() if known.ended}

    def _ask(self, name: str, known: _Known, *, exists: bool) -> None:
        """Ask the actor of a stream for a report, unless it has still to answer."""
        import ray

        if not exists:
            known.seen = replace(known.seen, happened="gone")
            return
        if known.handle is None:  # an earlier controller has started it
            try:
                known.handle = ray.get_actor(actor_name(self._name, "stream", name), namespace=NAMESPACE)
            except ValueError:  # it has died meanwhile
                return
            known.seen = Seen("pending", time.monotonic(), time.monotonic())
        known.seen = replace(known.seen, happened="")
        if known.call is None:
            spec = self._desired.spec.streams.get(name)
            known.call = known.handle.report.remote(self._clients, spec.follow if spec is not None else ())

    def _hear(self, name: str, known: _Known) -> None:
        """Take the answer of the actor of a stream, if it has arrived."""
        import ray
        from ray.exceptions import RayError

        if known.call is not None and ray.wait([known.call], timeout=0)[0]:
            call, known.call = known.call, None
            try:
                answer = ray.get(call)
                if isinstance(answer, Report):
                    self._take(known, answer)
                else:  # it has stopped
                    if self._phase == "down":
                        self._unstored[name] = answer
                    ray.kill(known.handle)
            except RayError as error:
                _log.warning("%s is interrupted: %s", name, str(error).partition("\n")[0])
                known.seen = replace(known.seen, happened="interrupted", node="")

    def _take(self, known: _Known, report: Report) -> None:
        """Keep a report."""
        known.report = report
        happened: life.Event = "reports"
        if report.superseded:
            happened = "superseded"
        elif report.status.state == "ended":
            happened, known.ended = "ended", report.order.digest
        known.seen = replace(
            known.seen, happened=happened, answered=time.monotonic(), order=report.order, node=report.status.node
        )

    def _do(self, name: str, step: Step, wanted: Wanted | None) -> None:
        """Do a step of a stream."""
        import ray

        known, now = self._streams[name], time.monotonic()
        before = known.seen.state
        _log.info("%s: %s, %s: %s %s", name, before, life.EVENTS[step.event], step.after, step.action)
        match step.action:
            case "start" if wanted is not None:
                self._start(name, known, wanted, now)
                return
            case "stop":
                known.call = known.handle.stop.remote("stopped" if wanted is None else "moved")
            case "restart":
                ray.kill(known.handle, no_restart=False)
            case "kill":
                ray.kill(known.handle)
        if step.after == "absent":
            known.seen = Seen("absent", known.started, known.seen.answered)
            known.handle = known.call = None
        elif step.after != before or step.action:
            known.seen = replace(known.seen, state=step.after, since=now, answered=now)

    def _start(self, name: str, known: _Known, wanted: Wanted, now: float) -> None:
        """Ask Ray to run a stream."""
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        spec, order = self._desired.spec, wanted.order(self._nodes)
        where = NodeAffinitySchedulingStrategy(order.node, soft=True) if order.node else "SPREAD"
        with suppress(ValueError):  # the name is taken: the actor before it is not quite gone
            known.handle = (
                ray.remote(StreamActor)
                .options(
                    name=actor_name(self._name, "stream", name),
                    namespace=NAMESPACE,
                    lifetime="detached",
                    num_cpus=order.cores,
                    max_restarts=-1,
                    max_concurrency=4,
                    label_selector=order.selector or None,
                    scheduling_strategy=where,
                )
                .remote(spec.streams[name], order, self._clients, spec.store, spec.every)
            )
            known.seen, known.ended, known.started = Seen("pending", now, now, order), "", now

    # What is shown.

    def _stream_status(self, name: str) -> StreamStatus:
        known = self._streams.get(name, _Known(Seen("absent")))
        source = without_password(self._desired.spec.streams[name].source)
        last = known.report.status if known.report is not None else StreamStatus(name, "starting", source=source)
        last = replace(last, node=self._node_name(known.seen.node))
        if known.seen.state == "working":
            quiet = time.monotonic() - known.seen.answered
            trouble = f"it has not answered for {quiet:.0f} s" if quiet > QUIET_SECONDS else last.trouble
            wanted = self._desired.wanted(name)
            leaves = self._phase == "up" and life.event(wanted, known.seen, self._nodes, time.monotonic()) == "unwanted"
            return replace(last, state="moving" if leaves else last.state, trouble=trouble)
        stored = last.stored_seconds
        age = None if stored is None else stored + time.monotonic() - known.seen.answered
        last = replace(last, endpoint="", server="", rate=0.0, cores=0.0, stored_seconds=age, trouble="")
        if known.ended == self._desired.spec.streams[name].digest:
            return replace(last, state="ended", node="")
        if known.seen.state == "stopping":
            return replace(last, state="moving" if self._phase == "up" else "stopping")
        if self._phase == "down":
            return replace(last, state="stopping", node="")
        trouble = self._waits_for(name)
        return replace(last, state="unplaced" if trouble else "starting", node="", trouble=trouble)

    def _waits_for(self, name: str) -> str:
        """What a stream that Ray has not placed waits for; empty if there is room for it."""
        wanted = self._desired.wanted(name)
        if reason := objection(wanted, self._nodes):
            return f"it {reason}"
        free = max(node.cores - self._used(node) for node in self._nodes if node.alive and wanted.fits(node))
        if free + 1e-6 >= wanted.cores:
            return ""
        return f"it waits for {wanted.cores:g} free cores: no node that it may run on has more than {free:.2g}"

    def _used(self, node: Node) -> float:
        """The cores that Ray has reserved for streams on a node."""
        here = (known.seen for known in self._streams.values() if known.seen.node == node.id)
        return sum(seen.order.cores for seen in here if seen.order is not None)

    def _node_name(self, id_: str) -> str:
        return next((node.name for node in self._nodes if node.id == id_), "")

    def _node_status(self, node: Node, streams: dict[str, StreamStatus]) -> NodeStatus:
        state: NodeState = "dead" if not node.alive else "draining" if node.draining else "alive"
        here = [each for each in streams.values() if each.node == node.name]
        slow = sum("it skips" in each.trouble for each in here)
        trouble = f"{slow} of its streams skip frames" if slow else ""
        used = self._used(node) if node.alive else 0.0
        return NodeStatus(node.name, state, node.address, node.cores, used, dict(node.labels), len(here), trouble)

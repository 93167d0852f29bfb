"""The manager of a fleet: an actor on the head that starts, watches and moves the streams, and answers the registry.

What is to be done is decided by `reconcile`, from the desired state and from what is observed; here it is carried out.
The desired state is in the store, and the streams are actors with names: a manager that starts again after its death
finds both, and touches no stream that runs.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import threading
import time
import uuid
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from catstream.errors import FleetError, StoreError
from catstream.fleet.cluster import FOLDER_VARIABLE, NAMESPACE, REGISTRY_VARIABLE, NodeFacts, nodes
from catstream.fleet.placement import Node, Task, objection, place
from catstream.fleet.reconcile import Actor, Desired, Memory, Phase, Plan, Start, Stop, reconcile
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.fleet.store import Store
from catstream.fleet.stream import Place as StreamPlace
from catstream.fleet.stream import Report, Stream, given_model
from catstream.messages import FleetStatus, NodeState, NodeStatus, StreamState, StreamStatus
from catstream.registry import RegistryServer
from catstream.video.frames import without_password
from catstream.wire.keys import Client, allowed

__all__ = ["Manager", "actor_name"]

#: Contents of saved models, by stream and object.
Models = dict[tuple[str, str], bytes]

_TURN_SECONDS = 0.05  # between two looks at the questions of the registry
_RECONCILE_SECONDS = 0.5
_RECENT_SECONDS = 0.3  # for which the registry answers with the same state
_ANSWER_SECONDS = 10.0  # limit for a stream to answer
_SILENT_SECONDS = 120.0  # after which a stream that does not answer counts as dead, on a busy machine too
_SAVE_SECONDS = 60.0  # between two copies of the measured cores in the store
_MODELS_SECONDS = 10.0  # between two looks at the merged models
_SKIPS_SECONDS = 5.0  # interval of the share of skipped frames
_FADES = 0.999  # factor by which the measured cores fall in each report, if fewer are used
_CLIENTS_SECONDS = 5.0  # between two looks at the keys of the clients
_STOP_SECONDS = 30.0  # limit for a stream to store its last state and to end
_SKIPPED_SHARE = 0.1  # of the frames of a node's streams, from which a node that is busy counts as overloaded
_BUSY_SHARE = 0.9  # of a node's cores that are used
_OVERLOADED_SECONDS = 15.0  # for so long, before a stream is moved
_UNMEASURED_CORES = 1.0  # of a stream that was never measured
_MARGIN = 1.2  # cores that a stream gets, as a multiple of those that were measured

_log = logging.getLogger(__name__)


def actor_name(fleet: str, kind: str, *parts: str) -> str:
    """The name of an actor: of the manager, or of a stream with a part that no other start of it has."""
    return "/".join([fleet, kind, *parts])


@dataclass(slots=True)
class _Running:
    """The actor of a stream, as the manager sees it.

    asked     the call for its report that was not answered yet
    answered  moment of its last answer
    stopping  the call that ends it
    kill      moment at which it is killed if it does not end
    dead      whether its process has died
    given     number of the merged model of each object that it was given
    """

    stream: str
    node: str
    digest: str
    handle: Any
    phase: Phase = "starting"
    since: float = field(default_factory=time.monotonic)
    report: Report | None = None
    asked: Any = None
    answered: float = field(default_factory=time.monotonic)
    stopping: Any = None
    kill: float = math.inf
    dead: bool = False
    given: dict[str, int] = field(default_factory=dict)

    def update(self) -> None:
        """Follow the phase of the actor."""
        phase = self._phase()
        if phase != self.phase:
            self.phase, self.since = phase, time.monotonic()

    def _phase(self) -> Phase:
        if self.stopping is not None:
            return "stopping"
        if self.dead:
            return "failed"
        if self.report is None:
            return "starting"
        match self.report.status.state:
            case "ended":
                return "ended"
            case "failed":
                return "unopened" if self.report.source_failed else "failed"
            case "starting":
                return "starting"
            case _:
                return "failed" if self.report.fenced else "running"


@dataclass(slots=True)
class _Skips:
    """The share of a stream's frames that were skipped in the last seconds."""

    since: float
    frame: int
    skipped: int
    share: float = 0.0

    def update(self, status: StreamStatus, now: float) -> None:
        """Compute the share if the interval is over."""
        if now - self.since >= _SKIPS_SECONDS:
            skipped, frames = max(0, status.skipped - self.skipped), max(0, status.frame - self.frame)
            self.share = skipped / max(1, skipped + frames)
            self.since, self.frame, self.skipped = now, status.frame, status.skipped


class Manager:
    """Runs as one actor of a fleet; the methods without an underscore are called by `catstream.fleet.Fleet`.

    Parameters
    ----------
    name : name of the fleet
    store : URL of the store
    local : whether all nodes and clients are on this machine; otherwise the sockets of all have keys
    """

    def __init__(self, name: str, store: str, *, local: bool) -> None:
        self._name, self._store = name, Store(store)
        self._keys = None if local else Path(os.environ[FOLDER_VARIABLE]) / "keys"
        listen = "" if local else os.environ[REGISTRY_VARIABLE]
        self._lock = threading.RLock()
        self._record = Record.from_json(text) if (text := self._store.get_fleet()) else Record(FleetSpec(name, store))
        self._memory = Memory()
        self._plan: Plan | None = None
        self._running: dict[str, _Running] = {}
        self._nodes = _workers()
        self._models: dict[str, int] = {}  # number of the newest merged model of each object
        self._skips: dict[str, _Skips] = {}
        self._overloaded: dict[str, float] = {}  # moment at which each node began to skip frames
        self._last: dict[str, StreamStatus] = {}  # the last report of each stream
        self._starts: dict[str, int] = {}
        self._clients: dict[str, Client] = {}
        self._recent = FleetStatus(name, 0.0)
        self._saved = self._clients_due = self._models_due = 0.0
        self._closing = False
        self._adopt()
        self._thread = threading.Thread(target=self._run, args=(listen,), name="manager", daemon=True)
        self._thread.start()

    # What `Fleet` calls.

    def apply(self, text: str, models: Models | None = None) -> list[str]:
        """Make a spec the desired state; returns what will be done, a line for each stream.

        Parameters
        ----------
        text : the spec, as `FleetSpec.to_json` writes it
        models : contents of the saved models that it names, by stream and object

        Raises
        ------
        FleetError
            If a stream fits on no node. Nothing is changed then.
        """
        with self._lock:
            spec = FleetSpec.from_json(text)
            if spec.store != self._record.spec.store:
                raise FleetError(
                    f"the fleet {self._name} keeps its state in {self._record.spec.store!r}, and the file says "
                    f"{spec.store!r}: end it first (catstream fleet down), and copy the state"
                )
            self._check_fits(spec)
            for (stream, name), data in (models or {}).items():
                self._store.put_model(given_model(stream, name), data, {})
            lines: list[str] = self._record.spec.changes(spec)
            self._record = replace(self._record, spec=spec)
            self._closing = False
            self._save()
            return lines

    def add(self, spec: StreamSpec, models: Models | None = None) -> list[str]:
        """Add a stream to those that there are, or change the one of its name."""
        with self._lock:
            streams = self._record.spec.streams | {spec.name: spec}
            lines = self.apply(replace(self._record.spec, streams=streams).to_json(), models)
            return [line for line in lines if line.startswith(f"{spec.name}:")]

    def remove(self, names: list[str], *, forget: bool) -> list[str]:
        """Remove streams; their state stays in the store, unless it is to be forgotten."""
        with self._lock:
            for name in names:
                self._check_stream(name)
            left = {name: each for name, each in self._record.spec.streams.items() if name not in names}
            lines = self.apply(replace(self._record.spec, streams=left).to_json())
            if forget:
                self._record = replace(self._record, forgotten=self._record.forgotten | set(names))
                self._save()
            return [line for line in lines if line.partition(":")[0] in names]

    def move(self, name: str, node: str) -> str:
        """Move a stream to a node, where it stays as long as the node can have it."""
        with self._lock:
            self._check_stream(name)
            self._check_node(node)
            desired = self._desired()[name]
            running = self._running.get(name)
            where = running.node if running is not None else None
            if where != node:
                task = Task(name, desired.cores, desired.labels)
                free = self._free()
                if reason := objection(task, [each for each in self._observed_nodes() if each.name == node], free):
                    raise FleetError(reason)
            self._record = replace(self._record, pins=self._record.pins | {name: node})
            self._save()
            return f"{name} stays on {node}" if where == node else f"{name} moves from {where or 'no node'} to {node}"

    def drain(self, node: str, *, undo: bool) -> str:
        """Give all streams of a node away and place none there, or take that back."""
        with self._lock:
            self._check_node(node)
            draining = self._record.draining - {node} if undo else self._record.draining | {node}
            self._record = replace(self._record, draining=draining)
            self._save()
            count = sum(each.node == node for each in self._running.values())
            return f"{node} takes streams again" if undo else f"{node} gives its {count} streams away and gets none"

    def status(self) -> FleetStatus:
        """The state of all streams and nodes."""
        with self._lock:
            streams = {name: self._stream_status(name) for name in sorted(self._record.spec.streams)}
            return FleetStatus(self._name, time.time(), streams, self._node_statuses())

    def spec(self) -> str:
        """The desired streams, as `FleetSpec.to_json` writes them."""
        return self._record.spec.to_json()

    def logs(self, name: str, lines: int) -> list[str]:
        """The last lines that a stream logged."""
        with self._lock:
            self._check_stream(name)
            running = self._running.get(name)
        if running is None or running.dead:
            raise FleetError(f"{name} runs on no node now, so its log cannot be read: see catstream fleet status")
        import ray

        logged: list[str] = ray.get(running.handle.logs.remote(lines), timeout=_ANSWER_SECONDS)
        return logged

    def close(self) -> int:
        """Stop all streams after their state was stored; returns how many still run."""
        with self._lock:
            self._closing = True
            return len(self._running)

    # The loop.

    def _run(self, listen: str) -> None:
        due = time.monotonic()
        with RegistryServer(listen, str(self._keys or ""), self._recent_status) as registry:
            while True:
                registry.turn(_TURN_SECONDS)
                if time.monotonic() >= due:
                    due = time.monotonic() + _RECONCILE_SECONDS
                    try:
                        self._turn()
                    except Exception:  # the next turn may succeed; the streams do not need the manager
                        _log.exception("A turn of the manager failed.")

    def _recent_status(self) -> FleetStatus:
        """The state of at most a third of a second ago: a large fleet is read in many parts, and by many clients."""
        if time.time() - self._recent.time > _RECENT_SECONDS:
            self._recent = self.status()
        return self._recent

    def _turn(self) -> None:
        """Observe, decide, and carry out."""
        facts = _workers()  # without the lock: it asks the head
        with self._lock:
            self._nodes = facts
            self._observe()
            self._share_clients()
            self._share_models()
            desired = {} if self._closing else self._desired()
            actors = {name: self._actor(each) for name, each in self._running.items()}
            plan = reconcile(self._memory, desired, self._observed_nodes(), actors, time.monotonic())
            self._plan, self._memory = plan, plan.memory
            if plan.unpinned:
                pins = {name: node for name, node in self._record.pins.items() if name not in plan.unpinned}
                self._record = replace(self._record, pins=pins)
            for action in plan.actions:
                if isinstance(action, Stop):
                    self._stop(action)
                else:
                    self._start(action)
            for name in plan.memory.ended.keys() & self._running.keys():
                if self._running[name].phase == "ended":
                    self._stop(Stop(name, "its source has ended"))
            self._forget_states()
            if time.monotonic() - self._saved > _SAVE_SECONDS:
                self._save()

    def _adopt(self) -> None:
        """Find the streams that an earlier manager has started."""
        import ray
        from ray.util import list_named_actors

        prefix = actor_name(self._name, "stream", "")
        for entry in list_named_actors(all_namespaces=True):
            if entry["namespace"] == NAMESPACE and entry["name"].startswith(prefix):
                stream, node, digest, _ = entry["name"].removeprefix(prefix).split("/")
                with contextlib.suppress(ValueError):  # it has died meanwhile
                    handle = ray.get_actor(entry["name"], namespace=NAMESPACE)
                    self._running[stream] = _Running(stream, node, digest, handle)

    def _observe(self) -> None:
        """Take the reports that have arrived, and ask for the next ones."""
        import ray
        from ray.exceptions import RayError

        for name, running in list(self._running.items()):
            waiting = running.stopping if running.stopping is not None else running.asked
            ready = waiting is not None and ray.wait([waiting], timeout=0)[0]
            if ready:
                try:
                    answer = ray.get(waiting)
                    if running.stopping is None:
                        running.report, running.asked, running.answered = answer, None, time.monotonic()
                        self._measure(name, answer.status)
                except RayError as error:
                    _log.warning("%s on %s: %s", name, running.node, str(error).splitlines()[0])
                    running.dead = True
            node = self._nodes.get(running.node)
            gone = node is None or not node.alive
            late = time.monotonic() > running.kill
            if not gone and time.monotonic() - running.answered > _SILENT_SECONDS and running.stopping is None:
                _log.warning("%s on %s has not answered for %.0f s, and is ended", name, running.node, _SILENT_SECONDS)
                self._kill(running)
                running.dead = True
            if gone or late or (running.stopping is not None and ready):
                self._kill(running)
                del self._running[name]
                continue
            if running.asked is None and running.stopping is None and not running.dead:
                running.asked = running.handle.report.remote()
            running.update()

    def _measure(self, name: str, status: StreamStatus) -> None:
        """Keep the processor cores of a stream, and whether it skips frames."""
        self._last[name] = status
        now = time.monotonic()
        if status.cores:
            before = self._record.cores.get(name, 0.0)
            highest = max(status.cores, _FADES * before)  # falls slowly
            self._record.cores[name] = round(highest, 3)
        skips = self._skips.setdefault(name, _Skips(now, status.frame, status.skipped))
        skips.update(status, now)

    def _start(self, action: Start) -> None:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        node = self._nodes[action.node]
        _log.info("%s starts on %s: %s", action.name, action.node, action.reason)
        place = StreamPlace(node.name, node.address if self._keys else "", self._clients)
        handle = (
            ray.remote(Stream)
            .options(
                name=actor_name(self._name, "stream", action.name, node.name, action.digest, uuid.uuid4().hex[:8]),
                namespace=NAMESPACE,
                lifetime="detached",
                num_cpus=0,
                max_restarts=0,  # `reconcile` starts it again, where it fits
                max_concurrency=4,
                scheduling_strategy=NodeAffinitySchedulingStrategy(node.id, soft=False),
            )
            .remote(self._record.spec.streams[action.name], place, self._record.spec.store, self._record.spec.every)
        )
        self._starts[action.name] = self._starts.get(action.name, 0) + 1
        self._running[action.name] = _Running(action.name, node.name, action.digest, handle)

    def _stop(self, action: Stop) -> None:
        running = self._running[action.name]
        _log.info("%s stops on %s: %s", action.name, running.node, action.reason)
        running.stopping = running.handle.stop.remote()
        running.kill = time.monotonic() + _STOP_SECONDS
        running.update()

    def _kill(self, running: _Running) -> None:
        import ray

        with contextlib.suppress(Exception):  # Ray raises many kinds of errors if it is gone already
            ray.kill(running.handle)

    def _share_clients(self) -> None:
        """Tell the streams which clients may connect, if that has changed."""
        if self._keys is None or time.monotonic() < self._clients_due:
            return
        self._clients_due = time.monotonic() + _CLIENTS_SECONDS
        clients = allowed(self._keys)
        if clients != self._clients:
            self._clients = clients
            for running in self._running.values():
                running.handle.allow.remote(clients)

    def _share_models(self) -> None:
        """Give the newest merged model of an object to the streams that follow it."""
        if time.monotonic() < self._models_due:
            return
        self._models_due = time.monotonic() + _MODELS_SECONDS
        streams = self._record.spec.streams
        try:
            for followed in {each for stream in streams.values() for each in stream.follow}:
                if (found := self._store.get_model(followed, self._models.get(followed, 0))) is not None:
                    self._models[followed] = found.number
        except StoreError as error:
            _log.warning("the merged models cannot be read: %s", error)
        for name, running in self._running.items():
            for followed in streams[name].follow if name in streams and running.phase == "running" else ():
                if (newest := self._models.get(followed, 0)) > running.given.get(followed, 0):
                    running.given[followed] = newest
                    running.handle.search.remote(followed)

    def _forget_states(self) -> None:
        """Remove the states of removed streams that are to be forgotten, once they have stopped."""
        for name in self._record.forgotten - self._running.keys():
            try:
                self._store.remove(name)
            except StoreError as error:
                _log.warning("the state of %s is not removed yet: %s", name, error)
                return
            self._record = replace(self._record, forgotten=self._record.forgotten - {name})

    def _save(self) -> None:
        """Write the desired state to the store; it is tried again later if the store cannot be reached."""
        self._saved = time.monotonic()
        try:
            self._store.put_fleet(self._record.to_json())
        except StoreError as error:
            _log.warning("the desired state cannot be stored: %s", error)

    # What is desired and observed, as `reconcile` takes it.

    def _desired(self) -> dict[str, Desired]:
        pins = self._record.pins
        return {
            name: Desired(spec.digest, self._cores(spec), spec.labels, pins.get(name))
            for name, spec in self._record.spec.streams.items()
        }

    def _cores(self, spec: StreamSpec) -> float:
        """Cores that a stream needs: as given, or as measured with a margin."""
        if spec.cores is not None:
            return spec.cores
        measured = self._record.cores.get(spec.name)
        return _UNMEASURED_CORES if measured is None else measured * _MARGIN

    def _actor(self, running: _Running) -> Actor:
        cores = self._record.cores.get(running.stream, _UNMEASURED_CORES)
        return Actor(running.node, running.digest, running.phase, running.since, cores)

    def _observed_nodes(self) -> list[Node]:
        now = time.monotonic()
        nodes = []
        for facts in self._nodes.values():
            if not self._is_overloaded(facts):
                self._overloaded.pop(facts.name, None)
            since = self._overloaded.setdefault(facts.name, now) if self._is_overloaded(facts) else now
            late = now - since >= _OVERLOADED_SECONDS
            draining = facts.name in self._record.draining
            nodes.append(Node(facts.name, facts.cores, facts.labels, facts.alive, draining, late))
        return nodes

    def _is_overloaded(self, facts: NodeFacts) -> bool:
        """Whether a node is busy and its streams skip frames."""
        here = [running for running in self._running.values() if running.node == facts.name and running.report]
        used = sum(running.report.status.cores for running in here if running.report)
        skipping = any(self._skips[running.stream].share > _SKIPPED_SHARE for running in here)
        return skipping and used >= _BUSY_SHARE * facts.cores

    def _free(self) -> dict[str, float]:
        """Free cores of the living nodes."""
        free = {facts.name: facts.cores for facts in self._nodes.values() if facts.alive}
        desired = self._desired()
        for name, running in self._running.items():
            if running.node in free and name in desired:
                free[running.node] -= desired[name].cores
        return free

    def _check_fits(self, spec: FleetSpec) -> None:
        """Raise FleetError if a stream of a spec fits on no node."""
        tasks = []
        for name, each in spec.streams.items():
            running = self._running.get(name)
            stays = running is not None and running.phase != "stopping" and not self._needs_more(each)
            node = running.node if running is not None and stays else None
            tasks.append(Task(name, self._cores(each), each.labels, node, self._record.pins.get(name)))
        placement = place(tasks, self._observed_nodes())
        if placement.unplaced:
            more = placement.more_nodes
            help_ = f"\n{more} more node{'s' * (more != 1)} as large as the largest would do" if more else ""
            raise FleetError("nothing was changed: " + "\n".join(placement.unplaced.values()) + help_)

    def _needs_more(self, spec: StreamSpec) -> bool:
        """Whether a stream is given more cores than before."""
        before = self._record.spec.streams.get(spec.name)
        return before is not None and spec.cores is not None and spec.cores > self._cores(before)

    def _check_stream(self, name: str) -> None:
        if name not in self._record.spec.streams:
            known = ", ".join(self._record.spec.streams) or "none"
            raise FleetError(f"there is no stream {name!r} in the fleet {self._name}: there are {known}")

    def _check_node(self, node: str) -> None:
        if node not in self._nodes:
            raise FleetError(f"there is no node {node!r} in the fleet {self._name}: there are {', '.join(self._nodes)}")

    # What is shown.

    def _stream_status(self, name: str) -> StreamStatus:
        spec, running = self._record.spec.streams[name], self._running.get(name)
        restarts = max(0, self._starts.get(name, 0) - 1)
        if running is not None and running.report is not None and not running.dead:
            state: StreamState = running.report.status.state
            if running.digest != spec.digest or (running.phase == "stopping" and state != "failed"):
                state = "moving"
            return replace(running.report.status, state=state, restarts=restarts)
        known = self._last.get(name, StreamStatus(name, "starting", source=without_password(spec.source)))
        known = replace(known, endpoint="", server="", rate=0.0, restarts=restarts)
        if running is not None:
            return replace(known, state="starting", node=running.node)
        unplaced = self._plan.unplaced.get(name, "") if self._plan is not None else ""
        if unplaced:
            return replace(known, state="unplaced", node="", trouble=unplaced)
        if name in self._memory.ended:
            return replace(known, state="ended", node="")
        waits = self._plan is not None and name in self._plan.waiting  # it has failed
        return replace(known, state="failed" if waits else "starting", node="")

    def _node_statuses(self) -> dict[str, NodeStatus]:
        free = self._free()
        statuses = {}
        for name, facts in sorted(self._nodes.items()):
            state: NodeState = "dead" if not facts.alive else "draining" if name in self._record.draining else "alive"
            count = sum(running.node == name for running in self._running.values())
            used = max(0.0, facts.cores - free.get(name, facts.cores))
            trouble = "its streams skip frames" if name in self._overloaded else ""
            statuses[name] = NodeStatus(name, state, facts.address, facts.cores, used, facts.labels, count, trouble)
        return statuses


def _workers() -> dict[str, NodeFacts]:
    """The nodes that streams may run on, by name."""
    return {facts.name: facts for facts in nodes() if not facts.head}


@dataclass(frozen=True, slots=True)
class Record:
    """The desired state of a fleet, as it is kept in the store.

    spec       the streams
    pins       node of each stream that was moved to one, by name
    draining   nodes that give their streams away
    cores      cores of each stream as measured, by name
    forgotten  removed streams whose state is to be removed too
    """

    spec: FleetSpec
    pins: dict[str, str] = field(default_factory=dict)
    draining: set[str] = field(default_factory=set)
    cores: dict[str, float] = field(default_factory=dict)
    forgotten: set[str] = field(default_factory=set)

    def to_json(self) -> str:
        """The text that `from_json` reads."""
        sets = {"draining": sorted(self.draining), "forgotten": sorted(self.forgotten)}
        return json.dumps({"spec": self.spec.to_json(), "pins": self.pins, "cores": self.cores} | sets)

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
            sets = {name: set(map(str, read[name])) for name in ("draining", "forgotten")}
            return cls(FleetSpec.from_json(read["spec"]), dict(read["pins"]), cores=dict(read["cores"]), **sets)
        except (ValueError, KeyError, TypeError) as error:
            raise FleetError(f"the desired state in the store is damaged ({error!r}): apply the file again") from None

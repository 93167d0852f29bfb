"""Compares the streams that a fleet should run with those that it runs, and decides what to start and to stop.

`reconcile` is a pure function. The manager calls it twice a second with what it observes, carries out the actions of
the plan, and passes the memory of the plan to the next call:

    plan = reconcile(memory, desired, nodes, actors, monotonic())
    memory = plan.memory

It promises, whatever happens to nodes and streams:

- A stream is started only if no actor of it is observed on a living node. So a stream that is moved or changed is
  stopped first, and started once it is gone.
- A stream that runs as it should on a node that may host it is never stopped, unless an overloaded node gives it away.
  If it should leave its node and fits nowhere else, it runs on.
- No stream is started on a node beyond the node's cores.
- A stream that failed is started again after a pause, which doubles from 1 s to 60 s with each failure. Failures are
  forgotten after a minute of running. If its source could not be opened, the other nodes are tried first.
- A stream that ended is not started again until it is changed, or removed and added.

A manager that starts anew begins with `Memory()`, or with the ended streams that the store knows. It then adopts all
actors that it observes. It must not call `reconcile` while it cannot observe the actors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from catstream.fleet.placement import Node, Task, may_host, place

__all__ = ["Actor", "Desired", "Failure", "Memory", "Phase", "Plan", "Start", "Stop", "reconcile"]

_FIRST_PAUSE, _LONGEST_PAUSE = 1.0, 60.0  # before a failed stream is started again, in seconds
_FORGOTTEN_SECONDS = 60.0  # of running, after which failures do not count any more
_SETTLING_SECONDS = 30.0  # before an overloaded node gives another stream away

#: What an actor does: `stopping` until it is gone, `ended` after the end of its source, `unopened` if its source could
#: not be opened, `failed` if it failed otherwise or its process died.
Phase = Literal["starting", "running", "stopping", "ended", "failed", "unopened"]


@dataclass(frozen=True, slots=True)
class Desired:
    """A stream that should run.

    digest  `StreamSpec.digest`: a stream whose digest changes is started anew
    cores   cores that it needs, as given or measured
    labels  labels that its node must have
    pinned  node that it was moved to by a command; None for any
    """

    digest: str
    cores: float
    labels: Mapping[str, str] = field(default_factory=dict)
    pinned: str | None = None


@dataclass(frozen=True, slots=True)
class Actor:
    """An actor of a stream, as it is observed.

    node    name of the node that it was started on
    digest  digest of the spec that it was started with
    phase   what it does; `starting` from the moment at which `Start` was carried out
    since   time at which the phase began, by the clock of `reconcile`
    cores   cores that it uses, for a stream that is not desired any more
    """

    node: str
    digest: str
    phase: Phase
    since: float
    cores: float = 0.0

    @property
    def is_working(self) -> bool:
        """Whether it starts or runs."""
        return self.phase in ("starting", "running")

    @property
    def has_failed(self) -> bool:
        """Whether it has to be started again."""
        return self.phase in ("failed", "unopened")


@dataclass(frozen=True, slots=True)
class Start:
    """Start a stream on a node.

    name    name of the stream
    node    name of the node
    digest  digest of the spec to start it with
    reason  why, for the log
    """

    name: str
    node: str
    digest: str
    reason: str


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop the actor of a stream and remove it; until it is gone, its phase is `stopping`."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class Failure:
    """The latest failure of a stream.

    digest    digest of the spec that failed; the failures of another spec do not count
    node      node on which it failed
    since     time at which it failed
    count     number of failures since it last ran for a minute
    unopened  nodes on which its source could not be opened, in order of the last attempt
    """

    digest: str
    node: str
    since: float
    count: int
    unopened: tuple[str, ...]

    @property
    def pause(self) -> float:
        """Seconds between the failure and the next start."""
        return min(_FIRST_PAUSE * 2.0 ** min(self.count - 1, 16), _LONGEST_PAUSE)


@dataclass(frozen=True, slots=True)
class Memory:
    """State that a call of `reconcile` passes to the next one.

    ended     digest of each stream that has ended
    failures  the latest failure of each stream that failed
    expected  node of each stream that should be observed as starting or running
    leaving   node that each stream goes to which an overloaded node gives away
    relieved  time at which each overloaded node last gave a stream away
    """

    ended: Mapping[str, str] = field(default_factory=dict)
    failures: Mapping[str, Failure] = field(default_factory=dict)
    expected: Mapping[str, str] = field(default_factory=dict)
    leaving: Mapping[str, str] = field(default_factory=dict)
    relieved: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Plan:
    """The result of `reconcile`.

    actions     what to do now, stops first
    unplaced    reason for each stream that fits on no node, also if it runs on one that it should leave
    more_nodes  number of nodes that the unplaced streams need, as in `Placement`
    unpinned    streams whose pin has ended: its node died, drains, has not their labels, or cannot open the source. The
                manager sets `Desired.pinned` of these to None
    waiting     time of the next start, for each stream that waits after a failure
    memory      for the next call
    """

    actions: list[Start | Stop]
    unplaced: dict[str, str]
    more_nodes: int
    unpinned: list[str]
    waiting: dict[str, float]
    memory: Memory


def reconcile(
    memory: Memory, desired: Mapping[str, Desired], nodes: Iterable[Node], actors: Mapping[str, Actor], now: float
) -> Plan:
    """Decide what to start and to stop, so that the desired streams run.

    Parameters
    ----------
    memory : of the previous plan
    desired : the streams that should run, by name
    nodes : all nodes, dead ones too
    actors : the observed actors, by name of the stream
    now : the time, by any monotonic clock

    Examples
    --------
    >>> desired = {"cam-7": Desired("a1", cores=0.5)}
    >>> plan = reconcile(Memory(), desired, [Node("n1", 4.0)], {}, now=0.0)
    >>> plan.actions
    [Start(name='cam-7', node='n1', digest='a1', reason='it does not run')]
    >>> actors = {"cam-7": Actor("n1", "a1", "running", since=1.0)}
    >>> reconcile(plan.memory, desired, [Node("n1", 4.0)], actors, now=2.0).actions
    []
    >>> reconcile(plan.memory, {}, [Node("n1", 4.0)], actors, now=2.0).actions
    [Stop(name='cam-7', reason='it was removed')]
    """
    return _Turn(memory, desired, {node.name: node for node in nodes}, actors, now).plan()


class _Turn:
    """One call of `reconcile`."""

    def __init__(
        self,
        memory: Memory,
        desired: Mapping[str, Desired],
        nodes: Mapping[str, Node],
        actors: Mapping[str, Actor],
        now: float,
    ) -> None:
        self._memory, self._desired, self._nodes, self._now = memory, desired, nodes, now
        self._observed = actors
        self._actors = {name: actor for name, actor in actors.items() if self._is_alive(actor.node)}
        self._ended = self._find_ended()
        self._wanted = {name: each for name, each in desired.items() if name not in self._ended}
        self._failures = self._find_failures()
        self._unpinned = sorted(name for name, each in desired.items() if self._pin_has_ended(name, each))
        self._leaving = {
            name: node
            for name, node in memory.leaving.items()
            if name in self._wanted and (name not in self._actors or self._actors[name].phase == "stopping")
        }
        self._relieved = {name: time for name, time in memory.relieved.items() if now - time < _SETTLING_SECONDS}

    def plan(self) -> Plan:
        """The actions, and what to remember."""
        tasks = [self._task(name, each) for name, each in self._wanted.items()]
        placement = place(tasks, self._free_nodes(), self._relieved)
        stops = self._stops(placement.where)
        for name, node in self._given_away(placement.where):
            self._leaving[name], self._relieved[self._actors[name].node] = node, self._now
        starts, waiting = self._starts(placement.where)
        stopped = {stop.name for stop in stops}
        expected = {
            name: actor.node for name, actor in self._actors.items() if actor.is_working and name not in stopped
        }
        expected |= {start.name: start.node for start in starts}
        memory = Memory(self._ended, self._failures, expected, self._leaving, self._relieved)
        return Plan([*stops, *starts], placement.unplaced, placement.more_nodes, self._unpinned, waiting, memory)

    # --- what is known of each stream -------------------------------------------------------------

    def _is_alive(self, name: str) -> bool:
        return name in self._nodes and self._nodes[name].alive

    def _find_ended(self) -> dict[str, str]:
        """The digest of each stream that has ended and was not changed since."""
        ended = {}
        for name, each in self._desired.items():
            actor = self._observed.get(name)
            is_known = self._memory.ended.get(name) == each.digest and not (actor and actor.is_working)
            if is_known or (actor and actor.phase == "ended" and actor.digest == each.digest):
                ended[name] = each.digest
        return ended

    def _find_failures(self) -> dict[str, Failure]:
        found = {name: self._failure(name, each) for name, each in self._wanted.items()}
        return {name: failure for name, failure in found.items() if failure is not None}

    def _failure(self, name: str, each: Desired) -> Failure | None:
        """The latest failure of a stream, None if there is none that counts."""
        last, actor = self._memory.failures.get(name), self._actors.get(name)
        if last is not None and last.digest != each.digest:
            last = None
        if actor is not None and actor.has_failed and actor.digest == each.digest:
            if last is not None and (last.node, last.since) == (actor.node, actor.since):
                return last
            return _next_failure(last, each.digest, actor.node, actor.since, is_unopened=actor.phase == "unopened")
        node = self._memory.expected.get(name)
        if node is not None and name not in self._observed and self._is_alive(node):  # its process died
            return _next_failure(last, each.digest, node, self._now, is_unopened=False)
        if actor is not None and actor.phase == "running" and self._now - actor.since >= _FORGOTTEN_SECONDS:
            return None
        return last

    def _pin_has_ended(self, name: str, each: Desired) -> bool:
        if each.pinned is None:
            return False
        node, actor = self._nodes.get(each.pinned), self._actors.get(name)
        if node is None or not may_host(node, each.labels):
            return True
        return actor is not None and actor.phase == "unopened" and actor.node == each.pinned

    # --- where each stream belongs ----------------------------------------------------------------

    def _task(self, name: str, each: Desired) -> Task:
        """The resources that a stream needs.

        The actor of a stream that ended, or whose source was not opened, occupies no cores.
        """
        actor, failure = self._actors.get(name), self._failures.get(name)
        node = actor.node if actor is not None and actor.phase not in ("ended", "unopened") else None
        return Task(name, each.cores, each.labels, node, self._target(name), failure.unopened if failure else ())

    def _target(self, name: str) -> str | None:
        """The node that a stream goes to by a command, or because its node is overloaded."""
        pinned = self._wanted[name].pinned if name not in self._unpinned else None
        return pinned or self._leaving.get(name)

    def _free_nodes(self) -> list[Node]:
        """The nodes without the cores of streams that are removed and not gone yet."""
        used = dict.fromkeys(self._nodes, 0.0)
        for name, actor in self._actors.items():
            if name not in self._desired:
                used[actor.node] += actor.cores
        return [replace(node, cores=node.cores - used[name]) for name, node in self._nodes.items()]

    # --- actions ----------------------------------------------------------------------------------

    def _stops(self, where: Mapping[str, str]) -> list[Stop]:
        reasons = {
            name: self._reason_to_stop(name, actor, where.get(name))
            for name, actor in sorted(self._actors.items())
            if actor.phase != "stopping"
        }
        return [Stop(name, reason) for name, reason in reasons.items() if reason]

    def _reason_to_stop(self, name: str, actor: Actor, target: str | None) -> str:
        """Why an actor has to be stopped, "" if it has not."""
        if name not in self._desired:
            return "it was removed"
        if actor.digest != self._desired[name].digest:
            return "it was changed"
        if actor.has_failed:
            what = "its source could not be opened" if actor.phase == "unopened" else "it failed"
            return f"{what} on {actor.node}"
        if actor.phase == "ended" or target is None or target == actor.node:
            return ""
        return f"it moves from {actor.node} to {target}: {self._reason_to_move(name, actor.node, target)}"

    def _reason_to_move(self, name: str, node: str, target: str) -> str:
        """Why a running stream leaves its node for another one."""
        if target == self._target(name):
            return "it was moved by a command"
        if self._nodes[node].draining:
            return f"{node} is drained"
        return f"{node} is overloaded" if self._fits(name, node) else f"{node} has not its labels"

    def _given_away(self, where: Mapping[str, str]) -> list[tuple[str, str]]:
        """The streams that overloaded nodes give away, and the nodes that they go to."""
        return [
            (name, where[name])
            for name, actor in self._actors.items()
            if actor.is_working
            and self._is_unchanged(name, actor)
            and self._fits(name, actor.node)
            and where.get(name, actor.node) not in (actor.node, self._target(name))
        ]

    def _is_unchanged(self, name: str, actor: Actor) -> bool:
        return name in self._wanted and self._wanted[name].digest == actor.digest

    def _fits(self, name: str, node: str) -> bool:
        """Whether a stream may be on a node."""
        return may_host(self._nodes[node], self._wanted[name].labels)

    def _starts(self, where: Mapping[str, str]) -> tuple[list[Start], dict[str, float]]:
        """The streams to start now, and the time of the next start of each stream that waits after a failure."""
        starts, waiting = [], {}
        for name, each in sorted(self._wanted.items()):
            failure, actor = self._failures.get(name), self._actors.get(name)
            if actor is not None and not actor.has_failed:
                continue
            due = failure.since + failure.pause if failure is not None and self._is_alive(failure.node) else self._now
            if due > self._now:
                waiting[name] = due
            elif actor is None and name in where:
                starts.append(Start(name, where[name], each.digest, self._reason_to_start(name, failure)))
        return starts, waiting

    def _reason_to_start(self, name: str, failure: Failure | None) -> str:
        node = self._memory.expected.get(name)
        if node is not None and not self._is_alive(node):
            return f"{node} died"
        if failure is not None:
            return f"it failed on {failure.node}, {failure.count} times since it last ran for a minute"
        return "it does not run"


def _next_failure(last: Failure | None, digest: str, node: str, since: float, *, is_unopened: bool) -> Failure:
    """The failure that follows the last one."""
    count, unopened = (last.count, last.unopened) if last is not None else (0, ())
    if is_unopened:
        unopened = (*(each for each in unopened if each != node), node)
    return Failure(digest, node, since, count + 1, unopened)

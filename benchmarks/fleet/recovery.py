"""Simulates the recovery of a fleet, event by event: failures, turns of the manager, start-ups, reads of states.

A stream that loses its machine goes through queues: Ray has to notice the failure, the manager to finish its turn and
to create the actors one after the other, the new machine to start the processes while others start, and the store to
send the state while it receives all the others. Each queue is simulated; nothing is a formula for the total.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count

import simpy
from model import GB, PERIOD, Size

__all__ = ["HeadLost", "NodesLost", "Outcome", "StoreLost", "assigned", "simulate"]

_CHECK_PERIOD, _CHECK_TIMEOUT, _CHECKS = 0.5, 1.5, 3  # Ray's health checks, as the fleet sets them
_START_CORES = 2  # cores that the processes of a stream keep busy while they start
_REQUESTS = 3  # to the store before a stream starts: list of states, claim, state
_ROUNDING = 1e-6  # of a state, which counts as read whole

Process = Generator[simpy.Event, object, None]


@dataclass(frozen=True, slots=True)
class NodesLost:
    """Machines fail.

    at      seconds since the begin
    nodes   numbers of the machines
    back    seconds until they are back
    silent  whether they vanish from the network, as without power; else, their connections are closed
    """

    at: float
    nodes: range
    back: float
    silent: bool = True


@dataclass(frozen=True, slots=True)
class HeadLost:
    """The head fails at a time, and is back after some seconds."""

    at: float
    back: float


@dataclass(frozen=True, slots=True)
class StoreLost:
    """The store cannot be reached from a time on, for some seconds."""

    at: float
    back: float


@dataclass(slots=True)
class Outcome:
    """The losses of the streams.

    down      seconds from each failure of a stream until it tracked again, in the order of the recoveries
    back_at   time of each of these recoveries
    unlearnt  seconds between the last state in the store and each failure: what was learned then is lost
    waiting   streams that do not run at the end
    """

    down: list[float] = field(default_factory=list)
    back_at: list[float] = field(default_factory=list)
    unlearnt: list[float] = field(default_factory=list)
    waiting: int = 0


def simulate(size: Size, faults: Iterable[NodesLost | HeadLost | StoreLost], seed: int, until: float) -> Outcome:
    """Simulate the faults in a fleet of one head, up to a time in seconds. The same seed gives the same outcome."""
    fleet = _Fleet(size, random.Random(seed))
    for fault in faults:
        fleet.env.process(fleet.fail(fault))
    fleet.env.run(until=until)
    fleet.outcome.waiting = len(fleet.down_since)
    return fleet.outcome


def assigned(streams: Iterable[int], free: Mapping[int, int], *, fullest_first: bool) -> dict[int, int]:
    """Give each stream a node; those without room are left out.

    Without `fullest_first`, the nodes are those that `catstream.fleet.placement.place` chooses for streams that need
    equally many cores, on nodes of one size.

    Parameters
    ----------
    free : for each node, the number of streams that there is room for
    """
    sign = 1 if fullest_first else -1
    nodes = [(sign * room, number) for number, room in free.items() if room > 0]
    heapq.heapify(nodes)
    found = {}
    for stream in streams:
        if not nodes:
            break
        room, number = nodes[0]
        found[stream] = number
        if abs(room) == 1:
            heapq.heappop(nodes)
        else:
            heapq.heapreplace(nodes, (room - sign, number))
    return found


class _Node:
    def __init__(self, env: simpy.Environment, size: Size) -> None:
        self.streams: set[int] = set()
        self.alive, self.life = True, 0
        self._env, self._size = env, size
        self.renew()

    def renew(self) -> None:
        """Begin with an empty queue of start-ups; as many start at once as there are free cores for."""
        free = self._size.site.cores - len(self.streams) * self._size.costs.cores
        self.starting = simpy.Resource(self._env, max(1, int(free) // _START_CORES))


class _Store:
    """Reads share the bandwidth of the store with each other and with the states that all streams write."""

    def __init__(self, env: simpy.Environment, size: Size) -> None:
        load = min(size.store_load / (size.site.store * GB), 1.0)
        self._writers = min(size.cameras, load / (1 - load)) if load < 1 else size.cameras  # on average at once
        self._env, self._size = env, size
        self._reads: list[tuple[float, int, simpy.Event]] = []
        self._sent, self._since = 0.0, 0.0  # bytes that a read which began at 0 would have, and when it had them
        self._number, self._changes = count(), 0

    def read(self) -> simpy.Event:
        """Return an event that happens when a state is read."""
        self._advance()
        done = self._env.event()
        heapq.heappush(self._reads, (self._sent + self._size.costs.state, next(self._number), done))
        self._env.process(self._finish())
        return done

    def _speed(self) -> float:
        site = self._size.site
        return GB * min(site.connection, site.store / (self._writers + len(self._reads)))

    def _advance(self) -> None:
        if self._reads:
            self._sent += (self._env.now - self._since) * self._speed()
        self._since = self._env.now

    def _finish(self) -> Process:
        """Wait for the end of the read that ends first, unless another one begins or ends before it."""
        self._changes += 1
        change = self._changes
        yield self._env.timeout(max(self._reads[0][0] - self._sent, 0.0) / self._speed())
        if change != self._changes:
            return
        self._advance()
        while self._reads and self._reads[0][0] <= self._sent + _ROUNDING * self._size.costs.state:
            heapq.heappop(self._reads)[2].succeed()
        if self._reads:
            self._env.process(self._finish())


class _Fleet:
    def __init__(self, size: Size, chance: random.Random) -> None:
        self.env, self.size, self.chance = simpy.Environment(), size, chance
        self.outcome = Outcome()
        self.nodes = [_Node(self.env, size) for _ in range(size.machines)]
        self.down_since: dict[int, float] = {}
        self._lost: list[int] = []  # streams of which the manager knows that they do not run
        self._seen = self.env.event()
        self._head_up = self._store_up = self.env.event().succeed()
        self._store_down_at: float | None = None
        self._store = _Store(self.env, size)
        self._ray = simpy.Resource(self.env)  # Ray's server on the head creates one actor after the other
        for stream, number in self._assigned(range(size.cameras)).items():
            self.nodes[number].streams.add(stream)
        for node in self.nodes:
            node.renew()
        self.env.process(self._manage())

    def fail(self, fault: NodesLost | HeadLost | StoreLost) -> Process:
        yield self.env.timeout(fault.at - self.env.now)
        if isinstance(fault, NodesLost):
            for number in fault.nodes:
                if self.nodes[number].alive:
                    self.env.process(self._lose(number, fault))
        elif isinstance(fault, HeadLost):
            up = self._head_up = self.env.event()
            yield self.env.timeout(fault.back)
            up.succeed()
        else:
            up, self._store_down_at = self.env.event(), self.env.now
            self._store_up = up
            yield self.env.timeout(fault.back)
            self._store_down_at = None
            up.succeed()

    def _lose(self, number: int, fault: NodesLost) -> Process:
        node, now = self.nodes[number], self.env.now
        node.alive, node.life = False, node.life + 1
        streams, node.streams = sorted(node.streams), set()
        for stream in streams:
            if stream not in self.down_since:  # a stream that was starting there is down already
                self.down_since[stream] = now
                self.outcome.unlearnt.append(self._age())
        yield self._head_up
        checks = (_CHECKS - 1) * _CHECK_PERIOD + (_CHECKS * _CHECK_TIMEOUT if fault.silent else 0.0)
        yield self.env.timeout(self.chance.uniform(0, _CHECK_PERIOD) + checks)
        self._report(streams)
        yield self.env.timeout(max(fault.back - (self.env.now - now), 0.0))
        node.alive = True
        node.renew()
        self._report([])  # the manager places again what had no room

    def _age(self) -> float:
        """Seconds since the last state of a stream was written."""
        age = self.chance.uniform(0, self.size.interval)
        return age if self._store_down_at is None else age + self.env.now - self._store_down_at

    def _report(self, streams: Sequence[int]) -> None:
        self._lost.extend(streams)
        if not self._seen.triggered:
            self._seen.succeed()

    def _manage(self) -> Process:
        """Turns of the manager; those that would change nothing are left out."""
        period = max(PERIOD, self.size.turn)
        while True:
            yield self._seen
            self._seen = self.env.event()
            yield self._head_up
            yield self.env.timeout(-self.env.now % period + self.size.turn)
            streams, self._lost = self._lost, []
            decision = self.size.costs.decision(self.size.cameras / self.size.site.heads, len(streams))
            yield self.env.timeout(decision)
            placed = self._assigned(streams)
            self._lost += [stream for stream in streams if stream not in placed]
            for stream, number in placed.items():
                yield self.env.timeout(self.size.costs.create)
                if self.nodes[number].alive:
                    self.nodes[number].streams.add(stream)
                    self.env.process(self._start(stream, number))
                else:
                    self._report([stream])

    def _assigned(self, streams: Iterable[int]) -> dict[int, int]:
        free = {number: self.size.slots - len(node.streams) for number, node in enumerate(self.nodes) if node.alive}
        return assigned(streams, free, fullest_first=self.size.site.fullest_first)

    def _start(self, stream: int, number: int) -> Process:
        """Create the actor in Ray, start its process, read the state, and start the stream's processes."""
        node, costs, latency = self.nodes[number], self.size.costs, self.size.site.latency
        life = node.life
        with self._ray.request() as turn:
            yield turn
            yield self.env.timeout(costs.gcs_create)
        with node.starting.request() as turn:
            yield turn
            yield self.env.timeout(costs.worker)
        yield self._store_up
        yield self.env.timeout(_REQUESTS * latency)
        yield self._store.read()
        with node.starting.request() as turn:
            yield turn
            yield self.env.timeout(max(costs.start, costs.start_cpu / _START_CORES))
        if node.life == life:
            self.outcome.down.append(self.env.now - self.down_since.pop(stream))
            self.outcome.back_at.append(self.env.now)

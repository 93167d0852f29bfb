"""Decides on which node each stream of a fleet runs: a pure function of the streams, their needs and the nodes.

A stream that runs and may stay, stays. Each of the others gets the node with the most free cores, so that the death of
a node stops few streams, and each has room to need more. Pinned streams come first, then those that run on a node that
they have to leave, those that need more labels, and those that need more cores. No stream is placed on a node beyond
the node's cores.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

__all__ = ["Node", "Placement", "Task", "may_host", "objection", "place"]

_ROUNDING = 1e-9  # sums of cores are exact up to this
_SHOWN = 5  # nodes that a message names; of the others it gives the number


@dataclass(frozen=True, slots=True)
class Node:
    """A node as it is observed.

    name        name of the node
    cores       cores that streams may use
    labels      labels by name, for example {"site": "north"}
    alive       whether the node answers
    draining    whether it has to give all its streams away
    overloaded  whether its streams have skipped frames for some seconds
    """

    name: str
    cores: float
    labels: Mapping[str, str] = field(default_factory=dict)
    alive: bool = True
    draining: bool = False
    overloaded: bool = False


@dataclass(frozen=True, slots=True)
class Task:
    """A stream that needs a node.

    name      name of the stream
    cores     cores that it needs
    labels    labels that its node must have
    node      node that it runs on now; None if it does not run
    pinned    node that it has to be on, as long as that node can take it; None for any
    unopened  nodes on which its source could not be opened, in order of the last attempt; they are tried last
    """

    name: str
    cores: float
    labels: Mapping[str, str] = field(default_factory=dict)
    node: str | None = None
    pinned: str | None = None
    unopened: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Placement:
    """The node of each stream.

    where       name of the node, by name of the stream
    unplaced    for each other stream, the reason as a sentence
    more_nodes  number of nodes as large as the largest one, with the necessary labels, that the unplaced streams need;
                streams that are too large for it are not counted
    """

    where: dict[str, str]
    unplaced: dict[str, str]
    more_nodes: int


def place(tasks: Iterable[Task], nodes: Iterable[Node], settling: Collection[str] = ()) -> Placement:
    """Assign each stream to a node.

    A running stream leaves its node only if the node is dead or drains, has not the labels of the stream any more, or
    if the stream is pinned to another node that has room. An overloaded node gives away its smallest stream that fits
    on a node that is not overloaded, unless the node has one stream only or is `settling`. A stream that leaves a
    living node occupies its cores there as well until it has stopped, so call this again after that.

    The result does not depend on the order of the arguments. It costs O(streams + moved streams * nodes).

    Parameters
    ----------
    tasks : all streams that should run
    nodes : all nodes, dead ones too
    settling : overloaded nodes that gave a stream away a short time ago, and do not give another one away yet

    Examples
    --------
    >>> nodes = [Node("north-1", 4.0, {"site": "north"}), Node("south-1", 2.0)]
    >>> placement = place([Task("cam-7", 0.5, {"site": "north"}), Task("cam-8", 1.0), Task("cam-9", 8.0)], nodes)
    >>> placement.where
    {'cam-7': 'north-1', 'cam-8': 'north-1'}
    >>> placement.unplaced
    {'cam-9': 'cam-9 needs 8 cores, and the largest node, north-1, has 4: give it fewer cores, or add a larger node'}
    """
    everyone = sorted(tasks, key=_order)
    room = _Room(everyone, nodes)
    where: dict[str, str] = {}
    unplaced: list[Task] = []
    for task in everyone:
        if task.node is not None and room.keeps(task):
            where[task.name] = task.node
        elif (node := room.best(task)) is not None:
            room.take(task, node)
            where[task.name] = node.name
        else:
            unplaced.append(task)
    for node in room.usable:
        if node.overloaded and node.name not in settling:
            room.relieve(node, [task for task in everyone if where.get(task.name) == node.name], where)
    reasons = {task.name: objection(task, room.nodes, room.free) for task in unplaced}
    return Placement(where, reasons, _more_nodes(unplaced, room.nodes))


def may_host(node: Node, labels: Mapping[str, str]) -> bool:
    """Whether a stream that needs these labels may run on a node: it is alive, does not drain, and has the labels."""
    return node.alive and not node.draining and _has(node, labels)


def _has(node: Node, labels: Mapping[str, str]) -> bool:
    return all(node.labels.get(key) == value for key, value in labels.items())


def _order(task: Task) -> tuple[object, ...]:
    return task.pinned is None, task.node is None, -len(task.labels), -task.cores, task.name


class _Room:
    """The nodes and their free cores while streams are placed."""

    def __init__(self, tasks: Iterable[Task], nodes: Iterable[Node]) -> None:
        self.nodes = sorted(nodes, key=lambda node: node.name)
        self.usable = [node for node in self.nodes if node.alive and not node.draining]
        self.free = {node.name: node.cores for node in self.nodes if node.alive}
        self._by_name = {node.name: node for node in self.nodes}
        for task in tasks:
            if task.node in self.free:
                self.free[task.node] -= task.cores

    def keeps(self, task: Task) -> bool:
        """Whether a running stream stays on its node."""
        node = self._by_name.get(task.node or "")
        if node is None or not may_host(node, task.labels):
            return False
        pinned = self._by_name.get(task.pinned or "")
        return pinned is None or pinned is node or not self._takes(pinned, task)

    def best(self, task: Task) -> Node | None:
        """The node for a stream that has to be placed: the pinned one, or the emptiest; None if there is none."""
        options = [node for node in self.usable if self._takes(node, task)]
        tried = {name: number for number, name in enumerate(task.unopened, 1)}
        return min(
            options,
            key=lambda node: (
                node.name != task.pinned,
                tried.get(node.name, 0),
                node.overloaded,
                -self.free[node.name],
                node.name,
            ),
            default=None,
        )

    def take(self, task: Task, node: Node) -> None:
        """Reserve the cores of a stream on a node."""
        self.free[node.name] -= task.cores

    def relieve(self, node: Node, tasks: Sequence[Task], where: dict[str, str]) -> None:
        """Give the smallest stream of an overloaded node away, if there is a node for it."""
        running = [task for task in tasks if task.node == node.name]
        if len(running) < 2:  # it would be as slow on another node
            return
        for task in sorted(running, key=lambda task: (task.cores, task.name)):
            other = None if task.pinned == node.name else self.best(task)
            if other is not None and not other.overloaded:
                self.take(task, other)
                where[task.name] = other.name
                return

    def _takes(self, node: Node, task: Task) -> bool:
        """Whether a stream that does not run on a node fits there."""
        return may_host(node, task.labels) and task.cores <= self.free[node.name] + _ROUNDING


def objection(task: Task, nodes: Iterable[Node], free: Mapping[str, float]) -> str:
    """Why a stream fits on none of some nodes, as a sentence that names the stream and the nodes; "" if it fits.

    Parameters
    ----------
    task : the stream
    nodes : the nodes, for example the only one that a command names
    free : free cores of the living nodes

    Examples
    --------
    >>> objection(Task("cam-7", 2.0), [Node("n1", 4.0)], {"n1": 0.5})
    'cam-7 needs 2 cores, and there are fewer free: n1 has 0.5 of 4: give it fewer cores, or add a node'
    """
    nodes = list(nodes)
    alive = [node for node in nodes if node.alive]
    labelled = [node for node in alive if _has(node, task.labels)]
    awake = [node for node in labelled if not node.draining]
    if any(task.cores <= free[node.name] + _ROUNDING for node in awake):
        return ""
    cores = f"{task.name} needs {_cores(task.cores)}"
    if not alive:
        dead = f" ({_named(nodes)})" if nodes else ""
        return f"{cores}, and no node is alive{dead}: start one with `catstream fleet node`"
    if not labelled:
        if lost := [node for node in nodes if _has(node, task.labels)]:
            labels = _labels(task.labels)
            return f"{task.name} needs a node with {labels}, and none is alive: start {_named(lost)} again"
        return _label_objection(task, alive)
    if not awake:
        return f"{cores}, and all nodes that it may be on are drained ({_named(labelled)}): add a node"
    largest = max(awake, key=lambda node: node.cores)
    if task.cores > largest.cores + _ROUNDING:
        which = "node" if len(labelled) == len(alive) else f"node with {_labels(task.labels)}"
        return (
            f"{cores}, and the largest {which}, {largest.name}, has {largest.cores:g}: give it fewer cores, or add a "
            "larger node"
        )
    shown = _listed([f"{node.name} has {max(0.0, free[node.name]):.3g} of {node.cores:g}" for node in awake])
    return f"{cores}, and there are fewer free: {shown}: give it fewer cores, or add a node"


def _label_objection(task: Task, alive: Sequence[Node]) -> str:
    """The sentence about a stream whose labels no living node has."""
    wanted = f"{task.name} needs a node with {_labels(task.labels)}, and there is none: "
    known = {key for node in alive for key in node.labels}
    if unknown := sorted(task.labels.keys() - known):
        near = difflib.get_close_matches(unknown[0], known, n=1)
        meant = f", did you mean {near[0]}?" if near else ""
        return (
            f"{wanted}no node has the label {unknown[0]}{meant} (alive: {_named(alive)}): "
            "correct the labels of the stream, or add such a node"
        )
    shown = _listed(
        [
            f"{node.name} has {_labels({key: node.labels[key] for key in task.labels.keys() & node.labels})}"
            for node in alive
            if task.labels.keys() & node.labels
        ]
    )
    return f"{wanted}{shown}: correct the labels of the stream, or add such a node"


def _more_nodes(unplaced: Iterable[Task], nodes: Sequence[Node]) -> int:
    """Number of nodes as large as the largest one for some streams, by first fit."""
    size = max((node.cores for node in nodes), default=0.0)
    free: list[float] = []
    labels: list[dict[str, str]] = []
    for task in unplaced:
        if task.cores > size + _ROUNDING:
            continue
        for number, has in enumerate(labels):
            agree = all(has.get(key, value) == value for key, value in task.labels.items())
            if agree and task.cores <= free[number] + _ROUNDING:
                break
        else:
            number = len(free)
            free.append(size)
            labels.append({})
        free[number] -= task.cores
        labels[number] |= task.labels
    return len(free)


def _cores(cores: float) -> str:
    return "1 core" if cores == 1 else f"{cores:.3g} cores"


def _labels(labels: Mapping[str, str]) -> str:
    return ", ".join(f"{key}={value}" for key, value in sorted(labels.items()))


def _named(nodes: Iterable[Node]) -> str:
    return _listed([node.name for node in nodes])


def _listed(words: Sequence[str]) -> str:
    """The first few words of a list, and the number of the others."""
    more = f" and {len(words) - _SHOWN} more" if len(words) > _SHOWN else ""
    return ", ".join(words[:_SHOWN]) + more

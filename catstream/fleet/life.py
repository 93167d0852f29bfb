"""The life of a stream of a fleet: what its controller does if something happens to it, as a table.

A stream is an actor of Ray, which Ray places, and starts again elsewhere if its process or its node dies. The states
here are those of the actor, as the controller sees it; what its pipeline does, its own reports say.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from catstream.fleet.timing import ADOPTED_SECONDS, PAUSE_SECONDS, SILENT_SECONDS, STOPPING_SECONDS

State = Literal["absent", "pending", "working", "stopping"]
Event = Literal["wanted", "reports", "interrupted", "silent", "unwanted", "superseded", "ended", "gone"]
Action = Literal["", "start", "stop", "restart", "kill"]

#: What each state is, for the documentation.
STATES: dict[State, str] = {
    "absent": "there is no actor",
    "pending": "Ray places it, or it starts",
    "working": "it reports",
    "stopping": "it stores its last state and ends, or was killed",
}

#: What each event is, for the documentation.
EVENTS: dict[Event, str] = {
    "wanted": "the stream should run, and has not ended",
    "reports": "the actor answers",
    "interrupted": "its process died: Ray starts it again",
    "silent": "it has not answered for so long that it hangs",
    "unwanted": "the stream was removed or changed, or has to leave its node",
    "superseded": "another process has claimed the stream",
    "ended": "its source has ended, and its last state is stored",
    "gone": "the actor has ended",
}

#: The next state and the action, by state and event; for an event that is not here, nothing changes.
TABLE: dict[tuple[State, Event], tuple[State, Action]] = {
    ("absent", "wanted"): ("pending", "start"),
    ("pending", "reports"): ("working", ""),
    ("pending", "unwanted"): ("stopping", "kill"),
    ("pending", "superseded"): ("stopping", "kill"),
    ("pending", "ended"): ("stopping", "stop"),
    ("pending", "gone"): ("absent", ""),
    ("working", "interrupted"): ("pending", ""),
    ("working", "silent"): ("pending", "restart"),
    ("working", "unwanted"): ("stopping", "stop"),
    ("working", "superseded"): ("stopping", "kill"),
    ("working", "ended"): ("stopping", "stop"),
    ("working", "gone"): ("absent", ""),
    ("stopping", "silent"): ("stopping", "kill"),
    ("stopping", "gone"): ("absent", ""),
}

#: Seconds after which an actor in a state counts as silent.
_SILENT: dict[State, float] = {"working": SILENT_SECONDS, "stopping": STOPPING_SECONDS}

#: Label that Ray gives to each node: its id.
_NODE_ID = "ray.io/node-id"


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the cluster.

    name      as given to `ray start --node-name`, by default its address
    id        of Ray; a node that was started again has another one
    address   its IP address
    cores     for actors
    labels    as given to `ray start --labels`
    alive     whether it answers Ray's health checks
    draining  whether its streams leave it, by `catstream fleet drain`
    """

    name: str
    id: str
    address: str = ""
    cores: float = 1.0
    labels: Mapping[str, str] = field(default_factory=dict)
    alive: bool = True
    draining: bool = False


@dataclass(frozen=True, slots=True)
class Wanted:
    """A stream that should run.

    digest  `StreamSpec.digest`: a stream whose digest changes is started again
    cores   that Ray reserves for it
    labels  that its node must have
    pinned  id of the node that it was moved to; "" for any
    """

    digest: str
    cores: float = 1.0
    labels: Mapping[str, str] = field(default_factory=dict)
    pinned: str = ""

    def target(self, nodes: Collection[Node]) -> Node | None:
        """The node that it was moved to; None if it may run on any, because that one has died or drains since."""
        return next((node for node in nodes if node.id == self.pinned and node.alive and not node.draining), None)

    def order(self, nodes: Collection[Node]) -> Order:
        """What Ray is asked for."""
        target = self.target(nodes)
        leaving = ",".join(sorted(node.id for node in nodes if node.draining))
        selector = dict(self.labels) | ({_NODE_ID: f"!in({leaving})"} if leaving else {})
        return Order(self.digest, self.cores, selector, target.id if target is not None else "")

    def fits(self, node: Node) -> bool:
        """Whether it may run on a node."""
        return not node.draining and self.labels.items() <= node.labels.items()


@dataclass(frozen=True, slots=True)
class Order:
    """What an actor was started for: it is a part of its reports.

    digest    of the stream
    cores     that Ray reserves
    selector  labels of its node, as Ray's `label_selector` takes them
    node      id of the node that it is placed on as long as that lives; "" for any
    """

    digest: str
    cores: float
    selector: dict[str, str]
    node: str = ""


@dataclass(frozen=True, slots=True)
class Seen:
    """An actor, as its controller sees it.

    state       its state
    since       moment at which the state began; of one that is absent, the moment of its last start
    answered    moment of its last answer
    order       what it was started for; None for one that an earlier controller started and that has not reported yet
    node        id of the node that it reported from; "" if it has not reported since it was placed
    happened    what has happened to it since the last look; "" for nothing
    """

    state: State
    since: float = float("-inf")
    answered: float = 0.0
    order: Order | None = None
    node: str = ""
    happened: Event | Literal[""] = ""


class Step(NamedTuple):
    """What happens to a stream, its state after that, and what is to be done."""

    event: Event
    after: State
    action: Action


def diff(
    wanted: Mapping[str, Wanted], seen: Mapping[str, Seen], nodes: Collection[Node], now: float
) -> dict[str, Step]:
    """What makes the actors those that should run, by stream.

    Parameters
    ----------
    wanted : the streams that should run
    seen : the actors; none is the same as one that is absent
    nodes : of the cluster
    now : the time, by the clock of `Seen`

    Examples
    --------
    >>> diff({"gate": Wanted("a1")}, {}, [], 0.0)
    {'gate': Step(event='wanted', after='pending', action='start')}
    >>> diff({}, {"roof": Seen("working", 0.0, 0.0)}, [], 0.0)
    {'roof': Step(event='unwanted', after='stopping', action='stop')}
    """
    steps = {}
    for name in sorted(wanted.keys() | seen.keys()):
        actor = seen.get(name, Seen("absent"))
        happened = event(wanted.get(name), actor, nodes, now)
        if happened is not None and (actor.state, happened) in TABLE:
            steps[name] = Step(happened, *TABLE[actor.state, happened])
    return steps


def event(wanted: Wanted | None, seen: Seen, nodes: Collection[Node], now: float) -> Event | None:
    """What happens to a stream now; None for nothing. The parameters are those of `diff`.

    >>> anywhere = Wanted("a1")
    >>> event(anywhere, Seen("working", node="1", order=anywhere.order([])), [Node("n1", "1", draining=True)], 0.0)
    'unwanted'
    """
    if seen.state == "absent":
        return "wanted" if wanted is not None and now - seen.since >= PAUSE_SECONDS else None
    if seen.happened == "gone":
        return "gone"
    if (seen.state, seen.happened) == ("working", "interrupted"):
        return "interrupted"  # it cannot be asked to stop
    last = seen.since if seen.state == "stopping" else seen.answered
    is_silent = now - last > _SILENT.get(seen.state, float("inf"))
    if seen.state != "stopping" and (wanted is None or not _is_as_wanted(wanted, seen, nodes, now)):
        return "unwanted"
    return seen.happened or ("silent" if is_silent else None)


def _is_as_wanted(wanted: Wanted, seen: Seen, nodes: Collection[Node], now: float) -> bool:
    """Whether an actor was started for what is wanted, and is, or will be placed, where it may be."""
    if seen.order is None:
        return now - seen.since < ADOPTED_SECONDS
    order = wanted.order(nodes)
    if (seen.order.digest, seen.order.cores) != (order.digest, order.cores):
        return False
    node = next((node for node in nodes if node.id == seen.node and node.alive), None)
    if node is None:
        return seen.order.selector == order.selector and order.node in ("", seen.order.node)
    return wanted.fits(node) and wanted.target(nodes) in (None, node)

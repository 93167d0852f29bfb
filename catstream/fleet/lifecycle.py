"""The life of a stream of a fleet: what its controller does if something happens to it, as a table. Without Ray.

A stream is an actor of Ray, which Ray places, and starts again elsewhere if its process or its node dies. The states
here are those of the actor, as the controller sees it; what its pipeline does, its own reports say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from catstream.fleet.spec import StreamSpec
from catstream.messages.kinds import StreamStatus

SILENT_SECONDS = 120.0  # without an answer, after which a stream is started again: a busy machine may be slow to answer
STOPPING_SECONDS = 30.0  # limit for a stream to store its last state and to end, before it is killed
_PAUSE_SECONDS = 5.0  # between two starts of one actor, at least: one may die each time, or be superseded

#: There is no actor; Ray places it, or it starts; it reports; it stores its last state and ends, or was killed.
State = Literal["absent", "pending", "working", "stopping"]
#: "unwanted" if it was removed or changed; "interrupted" if its process died, and Ray starts
#: it again; "gone" once the actor has ended.
Event = Literal["wanted", "reports", "interrupted", "silent", "unwanted", "superseded", "ended", "gone"]
Action = Literal["", "start", "stop", "restart", "kill"]

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


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the cluster.

    name     as given to `ray start --node-name`, by default its address
    id       of Ray; a node that was started again has another one
    address  its IP address
    cores    for actors
    labels   as given to `ray start --labels`
    alive    whether it answers Ray's health checks
    """

    name: str
    id: str
    address: str = ""
    cores: float = 1.0
    labels: Mapping[str, str] = field(default_factory=dict)
    alive: bool = True


@dataclass(slots=True)
class Actor:
    """The actor of a stream, as its controller sees it.

    state     its state
    since     moment at which the state began
    started   moment of its last start
    answered  moment of its last answer
    order     `StreamSpec.order` with which it was started: a part of its name
    node      id of the node that it reported from; "" if it has not reported since it was placed
    happened  what has happened to it since the last look; "" for nothing
    status    its last report; None before the first one
    ended     `StreamSpec.digest` with which its source has ended; "" if it has not
    handle    of Ray, if there is an actor
    call      the call for the next report, or that stops it, which was not answered yet
    """

    state: State = "absent"
    since: float = 0.0
    started: float = float("-inf")
    answered: float = 0.0
    order: str = ""
    node: str = ""
    happened: Event | Literal[""] = ""
    status: StreamStatus | None = None
    ended: str = ""
    handle: Any = None
    call: Any = None


def event(spec: StreamSpec | None, actor: Actor, now: float) -> Event | None:
    """The next event of a stream, None for none; it should not run if there is no spec of it.

    >>> gate = StreamSpec("gate", "demo:1")
    >>> event(gate, Actor(), 0.0)
    'wanted'
    >>> event(gate, Actor("working", order="another"), 0.0)
    'unwanted'
    """
    if actor.state == "absent":
        return "wanted" if spec is not None and now - actor.started >= _PAUSE_SECONDS else None
    if actor.happened == "gone":
        return "gone"
    if (actor.state, actor.happened) == ("working", "interrupted"):
        return "interrupted"  # it cannot be asked to stop
    if actor.state != "stopping" and (spec is None or spec.order != actor.order):
        return "unwanted"
    if actor.happened:
        return actor.happened
    last, limit = (actor.since, STOPPING_SECONDS) if actor.state == "stopping" else (actor.answered, SILENT_SECONDS)
    return "silent" if actor.state != "pending" and now - last > limit else None

"""The state of the page of a fleet, computed from the status of the fleet. It uses no socket and no clock."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, Literal

from catstream.messages.kinds import FleetStatus, NodeStatus, StreamStatus

__all__ = ["FleetDashboard", "in_order", "node_row", "stream_card"]

#: Phase of the fleet: no status yet, its registry answers, it does not answer now.
FleetPhase = Literal["waiting", "running", "silent"]

#: A card of a stream or a row of a node, as JSON values.
Card = dict[str, Any]

#: The part of the page -> the cards that a page knows, by name.
_Known = dict[str, Any]

#: States in which a stream can show a picture of its newest frame.
_WITH_PICTURE = ("running", "waiting", "paused")

#: Limits of the ages that are shown: an age changes on the page only when it passes one of them.
_AGES = (5, 10, 15, 30, 60)

_DIGITS = re.compile(r"(\d+)")


class FleetDashboard:
    """Receives the status of a fleet, and returns the updates for each open page.

    It keeps the last status while the fleet does not answer.

    Attributes
    ----------
    status : the last status, None before the first
    phase, reason : phase of the fleet, and the reason why it does not answer
    age : seconds since the last status arrived, 0 while the fleet answers
    """

    def __init__(self) -> None:
        self.status: FleetStatus | None = None
        self.phase: FleetPhase = "waiting"
        self.reason = ""
        self.age = 0.0
        self._arrived = 0.0
        self._streams: dict[str, Card] = {}
        self._nodes: dict[str, Card] = {}
        self._order: list[str] = []

    def take(self, status: FleetStatus, now: float) -> None:
        """Process a status that arrived at the time `now`, in seconds of a monotonic clock."""
        self.status, self.phase, self.reason, self.age, self._arrived = status, "running", "", 0.0, now
        streams = {name: stream_card(each, status.nodes.get(each.node)) for name, each in status.streams.items()}
        self._streams = _kept(streams, self._streams)
        self._nodes = _kept({name: node_row(each) for name, each in status.nodes.items()}, self._nodes)
        self._order = in_order(status.streams)

    def mark_silent(self, reason: str, now: float) -> None:
        """Record that the fleet did not answer at the time `now`."""
        self.reason = reason
        if self.status is not None:
            self.phase, self.age = "silent", now - self._arrived

    def updates(self, known: _Known) -> dict[str, object]:
        """Return what has changed since the last call for this page, as JSON values.

        Of `streams` and `nodes` only the changed fields of the changed ones are returned, None for one that is gone.

        Parameters
        ----------
        known : what the page has received; empty at first, updated by this call
        """
        parts: dict[str, object] = {}
        for name, value in (("fleet", self._fleet_part()), ("order", self._order)):
            if known.get(name) != value:
                parts[name] = known[name] = value
        for name, cards in (("streams", self._streams), ("nodes", self._nodes)):
            if changes := _changes(cards, known.get(name, {})):
                parts[name] = changes
            known[name] = cards
        return parts

    def _fleet_part(self) -> Card:
        name = self.status.name if self.status is not None else ""
        return {"name": name, "phase": self.phase, "reason": self.reason, "age": int(self.age)}


def stream_card(stream: StreamStatus, node: NodeStatus | None) -> Card:
    """Return what the page shows of a stream.

    Its `words` are the lower-case text in which the page searches: name, state, node, labels of the node, objects.

    Parameters
    ----------
    node : the node on which it runs, None if it runs on none
    """
    labels = [f"{name}={value}" for name, value in node.labels.items()] if node is not None else []
    return {
        "state": stream.state,
        "level": _trouble_level(stream),
        "trouble": stream.trouble,
        "node": stream.node,
        "source": stream.source,
        "rate": round(stream.rate, 1 if stream.rate < 9.95 else None),
        "models": list(stream.models.items()),
        "restarts": stream.restarts,
        "skipped": stream.skipped,
        "lost": [stream.lost_frames, round(stream.lost_seconds, 1)],
        "stored": None if stream.stored_seconds is None else _age(stream.stored_seconds),
        "picture": bool(stream.endpoint) and stream.state in _WITH_PICTURE,
        "words": " ".join([stream.name, stream.state, stream.node, *labels, *stream.models]).lower(),
    }


def node_row(node: NodeStatus) -> Card:
    """Return what the page shows of a node."""
    return {
        "state": node.state,
        "trouble": node.trouble,
        "address": node.address,
        "cores": round(node.cores, 2),
        "used": round(node.used, 2),
        "labels": [f"{name}={value}" for name, value in sorted(node.labels.items())],
        "streams": node.streams,
    }


def in_order(streams: Mapping[str, StreamStatus]) -> list[str]:
    """Return the names of streams: those that do not run because of trouble, others with trouble, the rest; by name.

    Examples
    --------
    >>> in_order({name: StreamStatus(name, state) for name, state in
    ...           {"cam-10": "running", "cam-9": "paused", "cam-11": "failed"}.items()})
    ['cam-11', 'cam-9', 'cam-10']
    """
    return sorted(streams, key=lambda name: (-_trouble_level(streams[name]), *_by_number(name)))


def _trouble_level(stream: StreamStatus) -> int:
    """Return 2 for a stream that does not run because of trouble, 1 for one that has trouble and runs, 0 for others."""
    return 2 if stream.state in ("failed", "unplaced") else 1 if stream.trouble else 0


def _by_number(name: str) -> tuple[list[tuple[int, str]], str]:
    """Return a key by which cam-9 sorts before cam-10."""
    parts: Iterable[str] = _DIGITS.split(name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name


def _age(seconds: float) -> int:
    """Return the limit that an age in seconds is below: 5, 10, 15, 30, 60, or whole minutes.

    Examples
    --------
    >>> [_age(seconds) for seconds in (0.4, 12, 59, 61)]
    [5, 15, 60, 120]
    """
    return next((limit for limit in _AGES if seconds < limit), 60 * (int(seconds // 60) + 1))


def _kept(cards: dict[str, Card], before: dict[str, Card]) -> dict[str, Card]:
    """Return cards, in place of an unchanged one the same object as before, so that changes are found fast."""
    return {name: before[name] if before.get(name) == card else card for name, card in cards.items()}


def _changes(cards: dict[str, Card], known: dict[str, Card]) -> dict[str, Card | None]:
    """Return the changed fields of the changed cards, None for a card that is gone."""
    changes: dict[str, Card | None] = {}
    for name, card in cards.items():
        before = known.get(name, {})
        if card is not before:
            changes[name] = {
                field: value for field, value in card.items() if field not in before or before[field] != value
            }
    return changes | {name: None for name in known if name not in cards}

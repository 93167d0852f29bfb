"""The desired state of a fleet, which is in the store, and the changes that a person makes to it. Pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from catstream.errors import FleetError
from catstream.fleet.life import Node, Wanted
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.run.job import changed_setting
from catstream.settings import Settings


@dataclass(frozen=True, slots=True)
class Desired:
    """The desired state of a fleet. A method that changes it returns the changed one, and raises FleetError.

    spec      the streams
    origin    machine and file that the streams came from
    pins      id of the node that each stream was moved to
    draining  names of the nodes that streams leave
    """

    spec: FleetSpec
    origin: str = ""
    pins: dict[str, str] = field(default_factory=dict)
    draining: frozenset[str] = frozenset()

    def applied(self, spec: FleetSpec, origin: str, *, replace_other: bool) -> Desired:
        """With the streams of a file, whose machine and path are the origin."""
        if spec.store != self.spec.store:
            raise FleetError(
                f"the fleet {self.spec.name} keeps its state in {self.spec.store!r}, and the file says "
                f"{spec.store!r}: end it first (catstream fleet down), and copy the state"
            )
        if origin and self.origin not in ("", origin) and self.spec.streams and not replace_other:
            raise FleetError(
                f"the fleet {self.spec.name} runs the streams of {self.origin}, not of {origin}: give this one "
                "another name (--name), or replace the streams (--replace)"
            )
        return replace(self._with(spec), origin=origin or self.origin)

    def added(self, stream: StreamSpec) -> Desired:
        """With one more stream, or with a change of the one of its name."""
        return self._with(replace(self.spec, streams=self.spec.streams | {stream.name: stream}))

    def removed(self, names: Collection[str]) -> Desired:
        """Without streams, of which nothing is left."""
        for name in names:
            self.check_stream(name)
        streams = {name: each for name, each in self.spec.streams.items() if name not in names}
        pins = {name: node for name, node in self.pins.items() if name in streams}
        return replace(self, spec=replace(self.spec, streams=streams), pins=pins)

    def moved(self, name: str, node: Node) -> Desired:
        """With a stream on a node, until that dies or drains: a node that was started again has another id."""
        self.check_stream(name)
        if reason := objection(self.wanted(name), self.with_draining([node])):
            raise FleetError(f"{name} {reason}")
        return replace(self, pins=self.pins | {name: node.id})

    def drained(self, node: Node, *, undo: bool) -> Desired:
        """With a node that streams leave, those too that were moved to it; `undo` lets it take streams again."""
        if undo:
            return replace(self, draining=self.draining - {node.name})
        pins = {name: id_ for name, id_ in self.pins.items() if id_ != node.id}
        return replace(self, draining=self.draining | {node.name}, pins=pins)

    def with_draining(self, nodes: Collection[Node]) -> list[Node]:
        """Nodes, with those marked that streams leave."""
        return [replace(node, draining=node.name in self.draining) for node in nodes]

    def wanted(self, name: str) -> Wanted:
        """A stream as it should run."""
        spec = self.spec.streams[name]
        return Wanted(spec.digest, spec.cores, spec.labels, self.pins.get(name, ""))

    def _with(self, spec: FleetSpec) -> Desired:
        """With other streams; each that is there already has to continue with the settings of its trees."""
        for name in self.spec.streams.keys() & spec.streams.keys():
            before, after = (Settings.from_values(each.streams[name].settings) for each in (self.spec, spec))
            if changed := changed_setting(before, after):
                raise FleetError(
                    f"nothing was changed: {name} was started with {changed}: keep the setting, or first remove the "
                    f"stream with what it has learned (catstream fleet remove {name} --forget)"
                )
        return replace(self, spec=spec)

    def check_stream(self, name: str) -> None:
        """Raise FleetError if there is no such stream."""
        if name not in self.spec.streams:
            known = ", ".join(self.spec.streams) or "none"
            raise FleetError(f"there is no stream {name!r} in the fleet {self.spec.name}: there are {known}")

    def unended(self, ended: Mapping[str, str]) -> dict[str, Wanted]:
        """The streams that should run: all but those that have ended with the digest that they have now."""
        wanted = {name: self.wanted(name) for name in self.spec.streams}
        return {name: each for name, each in wanted.items() if ended.get(name) != each.digest}

    def check_fits(self, nodes: Collection[Node], ended: Mapping[str, str]) -> None:
        """Raise FleetError if the nodes cannot run all streams but those that have `ended`."""
        nodes, wanted = self.with_draining(nodes), self.unended(ended)
        reasons = [f"{name} {reason}" for name, each in wanted.items() if (reason := objection(each, nodes))]
        if reasons := reasons or list(filter(None, [shortage(wanted.values(), nodes)])):
            raise FleetError(
                "nothing was changed: "
                + "\n".join(reasons)
                + "\nGive streams fewer cores (catstream fleet status shows what they use), add nodes, or let streams "
                "wait for nodes that join later (catstream fleet up --wait)"
            )


def objection(wanted: Wanted, nodes: Collection[Node]) -> str:
    """Why a stream can run on no node, even if no other stream ran; empty if it can.

    >>> objection(Wanted("a1", 4.0), [Node("n1", "1", cores=2.0)])
    'needs 4 cores, and the largest node that it may run on, n1, has 2'
    >>> objection(Wanted("a1", labels={"site": "north"}), [Node("n1", "1")])
    'needs a node with site=north, and there is none: there are n1'
    """
    alive = [node for node in nodes if node.alive]
    fitting = [node for node in alive if wanted.fits(node)]
    if not fitting:
        labels = ", ".join(f"{key}={value}" for key, value in wanted.labels.items())
        needed = f"a node with {labels}" if labels else "a node that is not drained"
        names = (f"{node.name}{' (drained)' * node.draining}" for node in alive)
        return f"needs {needed}, and there is none: there are {', '.join(names) or 'none'}"
    largest = max(fitting, key=lambda node: node.cores)
    if largest.cores < wanted.cores:
        return (
            f"needs {wanted.cores:g} cores, and the largest node that it may run on, {largest.name}, has "
            f"{largest.cores:g}"
        )
    return ""


def shortage(wanted: Collection[Wanted], nodes: Collection[Node]) -> str:
    """Why streams cannot all run at the same time; empty if they can, as far as the sums of cores say.

    >>> shortage([Wanted("a", 1.0)] * 20, [Node("n1", "1", cores=2.0), Node("n2", "2", cores=8.0, draining=True)])
    'the 20 streams need 20 cores, and the nodes have 2'
    """
    needed = sum(each.cores for each in wanted)
    there = sum(node.cores for node in nodes if node.alive and not node.draining)
    if needed <= there + 1e-6:
        return ""
    return f"the {len(wanted)} streams need {needed:g} cores, and the nodes have {there:g}"

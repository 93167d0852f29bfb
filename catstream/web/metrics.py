"""The metrics of a pipeline, or of the streams and nodes of a fleet, in Prometheus's text format."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from time import monotonic, time
from typing import Any, get_args

from prometheus_client import generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from catstream.messages.heads import TREES
from catstream.messages.kinds import FleetStatus, NodeState, StreamState
from catstream.web.dashboard import RUNNING, Dashboard
from catstream.web.feed import Feed, PipelineFeed
from catstream.web.streams import FleetFeed
from catstream.wire.channels import CHANNELS

_COUNTER, _GAUGE = CounterMetricFamily, GaugeMetricFamily

#: The samples of a metric: value by the values of its labels, a tuple of texts.
_Samples = Mapping[Any, float | None]
#: Type, name, labels, help text and samples of a metric; a sample without a value is left out.
_Row = tuple[type[CounterMetricFamily] | type[GaugeMetricFamily], str, tuple[str, ...], str, _Samples]


def text(feed: Feed) -> bytes:
    """Return the current metrics of what a feed shows, in Prometheus's text format."""
    rows = _of_fleet(feed) if isinstance(feed, FleetFeed) else _of_pipeline(feed.pipeline(""))
    return generate_latest(_Collected(rows))


class _Collected(Collector):
    """Rows as metrics."""

    def __init__(self, rows: Iterable[_Row]) -> None:
        self._rows = rows

    def collect(self) -> Iterator[Metric]:
        for kind, name, labels, meaning, samples in self._rows:
            known = {values: float(value) for values, value in samples.items() if value is not None}
            if labels or known:
                family = kind(f"catstream_{name}", meaning, labels=labels)
                for values, value in known.items():
                    family.add_metric(values, value)
                yield family


def _of_pipeline(feed: PipelineFeed) -> Iterator[_Row]:
    """The metrics of a pipeline; the label of an object without a name is empty."""
    dashboard = feed.dashboard
    yield _GAUGE, "up", (), "Whether the pipeline sends messages.", {(): dashboard.phase == "running"}
    yield _GAUGE, "viewers", (), "Open pages.", {(): feed.viewers}
    if dashboard.phase != "running":
        return
    sent, taken = dashboard.counter("detector", "sent"), dashboard.counter("detector", "taken")
    waiting = None if sent is None or taken is None else sent - taken
    rate = dashboard.rate(monotonic()) if dashboard.objects.shown else None
    yield _GAUGE, "frames_per_second", (), "Frames per second over the last two seconds.", {(): rate}
    yield _GAUGE, "features_waiting", (), "Features messages that the compressor has not received yet.", {(): waiting}
    for kind, name, counter, meaning in (
        (_COUNTER, "frames", "sent", "Frames processed."),
        (_COUNTER, "frames_skipped", "skipped", "Frames of a live source that were skipped."),
        (_COUNTER, "source_reopened", "reopened", "Times that a live source was lost and reopened."),
        (_COUNTER, "features_stored", "stored", "Features messages stored in the coreset trees."),
        (_GAUGE, "source_lost_seconds", "lost_seconds",
         "Seconds since a live source was lost, 0 while it is available."),
        (_GAUGE, "objects", "objects", "Objects that are tracked."),
    ):  # fmt: skip
        value = dashboard.counter("detector", counter)
        if value or counter not in ("sent", "stored"):  # which are 0 in a restarted detector until it has its position
            yield kind, name, (), meaning, {(): value}
    yield from _of_objects(dashboard)
    yield from _of_processes(dashboard)


def _of_objects(dashboard: Dashboard) -> Iterator[_Row]:
    labels, shown = ("object",), dashboard.objects.shown
    for kind, name, process, counter, meaning in (
        (_COUNTER, "rows", "compressor", "rows", "Rows inserted into the coreset trees."),
        (_COUNTER, "models_trained", "trainer", "trained", "Models trained."),
        (_GAUGE, "model_version", "detector", "model_version", "Version of the model that the detector uses."),
        (_GAUGE, "tree_bytes", "compressor", "bytes", "Memory of the coreset trees."),
    ):
        counters = dashboard.object_counters(process, counter)
        yield kind, name, labels, meaning, {(each,): value for each, value in counters.items()}
    yield (_GAUGE, "score", labels, "Score of the newest track: about 0 on background, about 1 on the object.",
           {(name,): each.score for name, each in shown.items()})  # fmt: skip
    yield (_GAUGE, "present", labels, "Whether the object is present.",
           {(name,): each.state != "absent" for name, each in shown.items()})  # fmt: skip
    yield (_GAUGE, "learning_latency_seconds", labels, "Seconds from the track of a frame to the model trained on it.",
           {(name,): each.model_latency for name, each in shown.items()})  # fmt: skip
    leaves = {tree: dashboard.object_counters("compressor", f"{tree}_leaves") for tree in TREES}
    yield (_GAUGE, "tree_leaves", ("object", "tree"), "Leaves ever inserted into a coreset tree.",
           {(name, tree): value for tree, counted in leaves.items() for name, value in counted.items()})  # fmt: skip


def _of_processes(dashboard: Dashboard) -> Iterator[_Row]:
    reports = {name: dashboard.health[name] for name in CHANNELS["health"].senders if name in dashboard.health}
    yield (_GAUGE, "health_age_seconds", ("process",), "Seconds since the last health report of a process.",
           {(name,): max(0.0, time() - report.time) for name, report in reports.items()})  # fmt: skip
    yield (_COUNTER, "rejected_messages", ("process",), "Messages that do not conform to the protocol.",
           {(name,): report.counters.get("rejected", 0) for name, report in reports.items()})  # fmt: skip


def _of_fleet(feed: FleetFeed) -> Iterator[_Row]:
    """The metrics of a fleet; those of a stream have the names that they have for its pipeline."""
    dashboard = feed.dashboard
    yield _GAUGE, "fleet_up", (), "Whether the fleet answers.", {(): dashboard.phase == "running"}
    yield _GAUGE, "fleet_age_seconds", (), "Age of the state of the fleet, 0 while it answers.", {(): dashboard.age}
    yield _GAUGE, "viewers", (), "Open pages of the fleet.", {(): feed.viewers}
    if dashboard.phase == "running":
        yield from _of_streams(dashboard.status)
        yield from _of_nodes(dashboard.status)


def _of_streams(status: FleetStatus) -> Iterator[_Row]:
    streams, labels = status.streams.values(), ("stream", "node")
    rows: tuple[tuple[Any, str, Callable[[Any], float | None], str], ...] = (
        (_COUNTER, "frames_skipped", lambda one: one.skipped, "Frames of a live source that were skipped."),
        (_GAUGE, "up", lambda one: one.state in RUNNING, "Whether the pipeline of the stream runs."),
        (_GAUGE, "frame", lambda one: one.frame, "Number of the newest frame that was tracked."),
        (_GAUGE, "stored_age_seconds", lambda one: one.stored_seconds, "Age of the newest state in the store."),
        (_GAUGE, "trouble", lambda one: bool(one.trouble), "Whether the stream has trouble."),
    )  # fmt: skip
    for kind, name, value, meaning in rows:
        yield kind, name, labels, meaning, {(one.name, one.node): value(one) for one in streams}
    versions = {(one.name, one.node, name): version for one in streams for name, version in one.models.items()}
    yield _GAUGE, "model_version", (*labels, "object"), "Version of the newest model.", versions
    counts = {(state,): sum(one.state == state for one in streams) for state in get_args(StreamState)}
    yield _GAUGE, "streams", ("state",), "Streams in each state.", counts


def _of_nodes(status: FleetStatus) -> Iterator[_Row]:
    nodes = status.nodes.values()
    rows: tuple[tuple[str, Callable[[Any], float], str], ...] = (
        ("node_up", lambda node: node.state != "dead", "Whether the node is alive."),
        ("node_cores", lambda node: node.cores, "Processor cores of the node that streams may use."),
        ("node_cores_used", lambda node: node.used, "Processor cores that the streams on the node need."),
        ("node_streams", lambda node: node.streams, "Streams on the node."),
    )
    for name, value, meaning in rows:
        yield _GAUGE, name, ("node",), meaning, {(node.name,): value(node) for node in nodes}
    counts = {(state,): sum(node.state == state for node in nodes) for state in get_args(NodeState)}
    yield _GAUGE, "nodes", ("state",), "Nodes in each state.", counts

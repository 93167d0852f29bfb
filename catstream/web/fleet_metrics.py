"""The metrics of the streams and nodes of a fleet in Prometheus's text format."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import get_args

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric

from catstream.messages.kinds import FleetStatus, NodeState, NodeStatus, StreamState, StreamStatus
from catstream.web.fleet_feed import FleetFeed

__all__ = ["text"]

_RUNNING = ("running", "waiting", "paused")

#: Name of each metric of a stream, how it is computed, and its help text; the names are as in `catstream.web.metrics`.
_COUNTED: tuple[tuple[str, Callable[[StreamStatus], float], str], ...] = (
    ("frames_skipped", lambda stream: stream.skipped, "Frames of a live source that were skipped."),
    ("restarts", lambda stream: stream.restarts, "Times that a stream was started again after a failure."),
    ("frames_lost", lambda stream: stream.lost_frames, "Frames of a live source lost because of failures and moves."),
    ("lost_seconds", lambda stream: stream.lost_seconds, "Duration of the lost frames."),
)
_GAUGES: tuple[tuple[str, Callable[[StreamStatus], float | None], str], ...] = (
    ("up", lambda stream: stream.state in _RUNNING, "Whether the pipeline of the stream runs."),
    ("frame", lambda stream: stream.frame, "Number of the newest frame that was tracked."),
    ("frames_per_second", lambda stream: stream.rate, "Tracked frames per second."),
    ("cores", lambda stream: stream.cores, "Processor cores that the stream uses."),
    ("stored_age_seconds", lambda stream: stream.stored_seconds, "Age of the newest state in the store."),
    ("trouble", lambda stream: bool(stream.trouble), "Whether the stream has trouble."),
)

#: The same of a node.
_NODE_GAUGES: tuple[tuple[str, Callable[[NodeStatus], float], str], ...] = (
    ("node_up", lambda node: node.state != "dead", "Whether the node is alive."),
    ("node_cores", lambda node: node.cores, "Processor cores of the node that streams may use."),
    ("node_cores_used", lambda node: node.used, "Processor cores that the streams on the node need."),
    ("node_streams", lambda node: node.streams, "Streams on the node."),
    ("node_trouble", lambda node: bool(node.trouble), "Whether the node has trouble."),
)


def text(feed: FleetFeed) -> bytes:
    """Return the current metrics in Prometheus's text format."""
    registry = CollectorRegistry()
    registry.register(_Collector(feed))
    return generate_latest(registry)


class _Collector:
    def __init__(self, feed: FleetFeed) -> None:
        self._feed = feed

    def collect(self) -> Iterator[Metric]:
        dashboard = self._feed.dashboard
        up = float(dashboard.phase == "running")
        yield GaugeMetricFamily("catstream_fleet_up", "Whether the fleet answers.", value=up)
        age = "Age of the state of the fleet, 0 while it answers."
        yield GaugeMetricFamily("catstream_fleet_age_seconds", age, value=dashboard.age)
        yield GaugeMetricFamily("catstream_viewers", "Open pages of the fleet.", value=float(self._feed.viewers.count))
        if dashboard.phase == "running" and dashboard.status is not None:
            yield from _streams(dashboard.status)
            yield from _nodes(dashboard.status)


def _streams(status: FleetStatus) -> Iterator[Metric]:
    streams = [(stream, [stream.name, stream.node]) for stream in status.streams.values()]
    for name, value, meaning in _COUNTED:
        counted = CounterMetricFamily(f"catstream_{name}", meaning, labels=["stream", "node"])
        for stream, labels in streams:
            counted.add_metric(labels, float(value(stream)))
        yield counted
    for name, measured, meaning in _GAUGES:
        gauge = GaugeMetricFamily(f"catstream_{name}", meaning, labels=["stream", "node"])
        for stream, labels in streams:
            if (now := measured(stream)) is not None:
                gauge.add_metric(labels, float(now))
        yield gauge
    versions = GaugeMetricFamily(
        "catstream_model_version", "Version of the newest model.", labels=["stream", "node", "object"]
    )
    states = GaugeMetricFamily("catstream_streams", "Streams in each state.", labels=["state"])
    for stream, labels in streams:
        for name, version in stream.models.items():
            versions.add_metric([*labels, name], version)
    for state in get_args(StreamState):
        states.add_metric([state], sum(stream.state == state for stream, _ in streams))
    yield from (versions, states)


def _nodes(status: FleetStatus) -> Iterator[Metric]:
    for name, value, meaning in _NODE_GAUGES:
        gauge = GaugeMetricFamily(f"catstream_{name}", meaning, labels=["node"])
        for node in status.nodes.values():
            gauge.add_metric([node.name], float(value(node)))
        yield gauge
    states = GaugeMetricFamily("catstream_nodes", "Nodes in each state.", labels=["state"])
    for state in get_args(NodeState):
        states.add_metric([state], sum(node.state == state for node in status.nodes.values()))
    yield states

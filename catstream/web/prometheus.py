"""The counters of a pipeline, or of the streams and nodes of a fleet, in Prometheus's text format.

Each counter of the health reports is a metric `catstream_PROCESS_COUNTER`, with the label `object` if it is one of each
object; it begins again at 0 with a restarted process, which `rate` and `increase` of Prometheus take into account.
Each metric of a pipeline names its source, without user and password.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields
from time import time

from prometheus_client import CollectorRegistry, Gauge, generate_latest
from starlette.responses import Response

from catstream.messages.kinds import FleetStatus, NodeStatus, StreamStatus
from catstream.web.feed import PipelineFeed

#: A sample: name, value and labels.
Sample = tuple[str, float, dict[str, str]]


def response(samples: Iterable[Sample]) -> Response:
    registry, metrics = CollectorRegistry(), dict[str, Gauge]()
    for name, value, labels in samples:
        if name not in metrics:
            metrics[name] = Gauge(f"catstream_{name}", name.replace("_", " "), list(labels), registry=registry)
        (metrics[name].labels(**labels) if labels else metrics[name]).set(value)
    return Response(generate_latest(registry), media_type="text/plain; version=0.0.4; charset=utf-8")


def of_pipeline(feed: PipelineFeed) -> Iterator[Sample]:
    """The samples of a pipeline; only `up` and `state` while it does not run."""
    dashboard = feed.dashboard
    yield "viewers", feed.viewers, {}
    running, of = dashboard.phase == "running", {"source": dashboard.source}
    yield "up", running, of
    yield "state", 1, of | {"state": dashboard.state[0]}
    if running and "detector" in dashboard.health:
        counters = dashboard.health["detector"].counters
        yield "paused", counters.get("paused", 0.0), of
        yield "source_lost_seconds", counters.get("lost_seconds", 0.0) if dashboard.state[0] == "lost" else 0.0, of
    for process, report in dashboard.health.items() if running else ():
        yield f"{process}_age_seconds", max(0.0, time() - report.time), of
        of_objects = {counter for counters in report.objects.values() for counter in counters}
        for counter in report.counters.keys() - of_objects:  # their sums are left to Prometheus
            yield f"{process}_{counter}", report.counters[counter], of
        for name, counters in report.objects.items():
            for counter, value in counters.items():
                yield f"{process}_{counter}", value, of | {"object": name}


def of_fleet(status: FleetStatus | None) -> Iterator[Sample]:
    """The samples of a fleet: each number of its streams and nodes; only `fleet_up` if it does not answer."""
    yield "fleet_up", status is not None, {}
    if status is None:
        return
    for stream in status.streams.values():
        labels = {"stream": stream.name, "node": stream.node}
        yield from _of_status("stream", stream, labels)
        yield "stream_trouble", bool(stream.trouble), labels
        for name, version in stream.models.items():
            yield "stream_model_version", version, labels | {"object": name}
        for name, is_present in stream.present.items():
            yield "fleet_objects_present", is_present, {"stream": stream.name, "object": name}
    for node in status.nodes.values():
        yield from _of_status("node", node, {"node": node.name})


def _of_status(kind: str, status: StreamStatus | NodeStatus, labels: dict[str, str]) -> Iterator[Sample]:
    yield f"{kind}_state", 1, labels | {"state": status.state}
    for field in fields(status):
        if field.name != "token" and isinstance(value := getattr(status, field.name), int | float):  # of the store
            yield f"{kind}_{field.name}", value, labels

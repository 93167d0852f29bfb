"""The metrics of a pipeline, or of the streams and nodes of a fleet, in Prometheus's text format.

Each counter of the health reports is a metric `catstream_PROCESS_COUNTER`, with the label `object` if each object has
it. Counters that only increase are Prometheus counters and end with `_total`. They restart at 0 with a process, which
`rate` and `increase` of Prometheus handle. Each metric of a pipeline has its source, without user and password.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields
from time import monotonic, time

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, disable_created_metrics, generate_latest
from starlette.responses import Response

from catstream.web.feed import PipelineFeed
from catstream.wire.heads import TREES
from catstream.wire.messages import FleetStatus, NodeStatus, StreamStatus

# Otherwise each counter would have a second metric with the time of its first sample.
disable_created_metrics()  # type: ignore[no-untyped-call]

#: A sample: name, value and labels.
Sample = tuple[str, float, dict[str, str]]

#: Counters of the processes, streams and nodes that only increase.
_COUNT_UP = {"sent", "processed", "stored", "skipped", "reconnects", "damaged", "scaled", "rejected", "frames", "rows"}
_COUNT_UP |= {"not_written", "leaves", "trained", "missed", *(f"{tree}_leaves" for tree in TREES)}

#: Counters of the detector without a metric: constants, and counters in `state`, `paused` and `source_lost_seconds`.
_OMITTED = {"paused", "waiting", "ended", "lost_seconds", "zero_time", "width", "height", "start", "stride"}

#: Help of each metric, by its name or by the name of the counter in the health reports.
_HELP = {
    "up": "1 if the pipeline sends messages.",
    "state": "1 for the present state: none, starting, running, paused, waiting (for a box), lost, silent or ended.",
    "paused": "1 if the run is paused.",
    "source_lost_seconds": "Seconds for which the live source has been lost, 0 while it is connected.",
    "tracked_frames_per_second": "Frames per second whose tracks have arrived, over the last 2 s.",
    "viewers": "Open pages.",
    "age_seconds": "Seconds since the last health report of this process.",
    "sent": "Tracked frames, whose features were sent to the compressor.",
    "processed": "Tracked frames whose features the compressor has received.",
    "stored": "Tracked frames whose features are in the coreset trees.",
    "not_written": "Frames that are missing in the results, because they could not be written.",
    "write_failed": "1 while results (detector) or checkpoints (compressor) cannot be written.",
    "skipped": "Frames of a live source that were not tracked, because a newer one had arrived.",
    "reconnects": "Reconnections to a live source.",
    "damaged": "Frames of a file that could not be decoded.",
    "scaled": "Frames with another size than the first one.",
    "truncated": "Seconds that are missing at the end of the file.",
    "rejected": "Invalid messages that were dropped, and connections that were refused.",
    "model_version": "Version of the newest model; the trainer numbers models from 1.",
    "objects": "Number of objects.",
    "time": "Time of the newest tracked frame in seconds since the start of the source, or of the run if it is live.",
    "rate": "Frames per second of the source, as it states or was measured at its start.",
    "score": "Score of the newest track: about 0 on background, about 1 on the object.",
    "present": "1 if the object is present in the newest frame.",
    "frames": "Frames whose features have arrived.",
    "version": "Version of the newest sample of the coreset trees, or of the newest model trained from one.",
    "rows": "Training rows that were inserted into the coreset trees.",
    "leaves": "Leaves that were inserted into the coreset trees.",
    "level": "Highest level of a node of the coreset trees.",
    "nodes": "Nodes of the coreset trees.",
    "bytes": "Bytes of the coreset trees.",
    "trained": "Models that were trained.",
    "fleet_up": "1 if the fleet answers.",
    "fleet_objects_present": "1 if an object of a stream is present in its newest frame.",
    "stream_state": "1 for the present state of the stream.",
    "stream_live": "1 if the source is live.",
    "stream_frame": "Number of the newest tracked frame.",
    "stream_missed": "Frames and events that destinations of the stream lack, since its pipeline was started.",
    "stream_stored_seconds": "Seconds since the store had the newest state of the stream.",
    "stream_trouble": "1 if there is a problem with the stream.",
    "node_state": "1 for the present state of the node.",
    "node_cores": "Processor cores that streams may use.",
    "node_used": "Processor cores that are reserved for streams.",
    "node_streams": "Streams on the node.",
    **{f"{name}_leaves": f"Leaves that were inserted into this tree: {tree.meaning}." for name, tree in TREES.items()},
}


def response(samples: Iterable[Sample], *histograms: Histogram) -> Response:
    registry, metrics = CollectorRegistry(), dict[str, Counter | Gauge]()
    for histogram in histograms:
        registry.register(histogram)
    for name, value, labels in samples:
        if name not in metrics:
            counter = name.partition("_")[2]
            text = _HELP.get(name) or _HELP.get(counter, "A counter of the health reports.")
            kind = Counter if counter in _COUNT_UP else Gauge
            metrics[name] = kind(f"catstream_{name}", text, list(labels), registry=registry)
        (metrics[name].labels(**labels) if labels else metrics[name]).inc(value)
    return Response(generate_latest(registry), media_type="text/plain; version=0.0.4; charset=utf-8")


def of_pipeline(feed: PipelineFeed) -> Iterator[Sample]:
    """The samples of a pipeline; only `viewers`, `up` and `state` while it does not run."""
    dashboard = feed.dashboard
    yield "viewers", feed.viewers, {}
    running, of = dashboard.phase == "running", {"source": dashboard.source}
    yield "up", running, of
    yield "state", 1, of | {"state": dashboard.state[0]}
    if running and "detector" in dashboard.health:
        counters = dashboard.health["detector"].counters
        yield "tracked_frames_per_second", dashboard.rate(monotonic()), of
        yield "paused", counters.get("paused", 0.0), of
        yield "source_lost_seconds", counters.get("lost_seconds", 0.0) if dashboard.state[0] == "lost" else 0.0, of
    for process, report in dashboard.health.items() if running else ():
        yield f"{process}_age_seconds", max(0.0, time() - report.time), of
        of_objects = {counter for counters in report.objects.values() for counter in counters}
        for counter in report.counters.keys() - of_objects - _OMITTED:  # Prometheus can sum over objects
            yield f"{process}_{counter}", report.counters[counter], of
        for name, counters in report.objects.items():
            for counter, value in counters.items():
                yield f"{process}_{counter}", value, of | {"object": name}


def of_fleet(status: FleetStatus | None) -> Iterator[Sample]:
    """The samples of a fleet: each numeric field of its streams and nodes; only `fleet_up` if it does not answer."""
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
        if field.name != "token" and isinstance(value := getattr(status, field.name), int | float):  # a fencing token
            yield f"{kind}_{field.name}", value, labels

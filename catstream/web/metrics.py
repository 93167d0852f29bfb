"""The metrics of a pipeline in Prometheus's text format."""

from __future__ import annotations

from collections.abc import Iterator
from time import monotonic, time

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric

from catstream.messages.heads import TREES
from catstream.web.feed import Feed
from catstream.wire.channels import CHANNELS

__all__ = ["text"]

#: Name of each metric, its process and counter in the health reports, and its help text.
_COUNTED = (
    ("frames", "detector", "sent", "Frames processed."),
    ("frames_skipped", "detector", "skipped", "Frames of a live source that were skipped."),
    ("source_reopened", "detector", "reopened", "Times that a live source was lost and reopened."),
    ("features_stored", "detector", "stored", "Features messages stored in the coreset trees."),
)
_GAUGES = (
    (
        "source_lost_seconds",
        "detector",
        "lost_seconds",
        "Seconds since a live source was lost, 0 while it is available.",
    ),
    ("objects", "detector", "objects", "Objects that are tracked."),
)

#: The same of the metrics with a value for each object.
_COUNTED_BY_OBJECT = (
    ("rows", "compressor", "rows", "Rows inserted into the coreset trees."),
    ("models_trained", "trainer", "trained", "Models trained."),
)
_GAUGES_BY_OBJECT = (
    ("model_version", "detector", "model_version", "Version of the model that the detector uses."),
    ("tree_bytes", "compressor", "bytes", "Memory of the coreset trees."),
)


def text(feed: Feed) -> bytes:
    """Return the current metrics in Prometheus's text format."""
    registry = CollectorRegistry()
    registry.register(_Collector(feed))
    return generate_latest(registry)


class _Collector:
    def __init__(self, feed: Feed) -> None:
        self._feed = feed

    def collect(self) -> Iterator[Metric]:
        dashboard = self._feed.dashboard
        yield _gauge("up", "Whether the pipeline sends messages.", dashboard.phase == "running")
        yield _gauge("viewers", "Open pages.", self._feed.viewers.count)
        for name, process, counter, meaning in _COUNTED:
            if (value := dashboard.counter(process, counter)) is not None:
                yield CounterMetricFamily(f"catstream_{name}", meaning, value=value)
        for name, process, counter, meaning in _GAUGES:
            if (value := dashboard.counter(process, counter)) is not None:
                yield _gauge(name, meaning, value)
        if dashboard.objects.shown:
            frames = "Frames per second over the last two seconds."
            yield _gauge("frames_per_second", frames, dashboard.rate(monotonic()))
        sent, taken = dashboard.counter("detector", "sent"), dashboard.counter("detector", "taken")
        if sent is not None and taken is not None:
            yield _gauge("features_waiting", "Features messages that the compressor has not received yet.",
                         sent - taken)  # fmt: skip
        yield from self._objects()
        yield from self._processes()

    def _objects(self) -> Iterator[Metric]:
        """The metrics with a value for each object; the label of an object without a name is empty."""
        dashboard = self._feed.dashboard
        for name, process, counter, meaning in _COUNTED_BY_OBJECT:
            yield _by_object(CounterMetricFamily, name, meaning, dashboard.object_counters(process, counter))
        for name, process, counter, meaning in _GAUGES_BY_OBJECT:
            yield _by_object(GaugeMetricFamily, name, meaning, dashboard.object_counters(process, counter))
        shown = dashboard.objects.shown
        latencies = {name: each.model_latency for name, each in shown.items() if each.model_latency is not None}
        for name, meaning, values in (
            ("score", "Score of the newest track: about 0 on background, about 1 on the object.",
             {name: each.score for name, each in shown.items()}),
            ("present", "Whether the object is present.",
             {name: float(each.state != "absent") for name, each in shown.items()}),
            ("learning_latency_seconds", "Seconds from the track of a frame to the model trained on it.", latencies),
        ):  # fmt: skip
            yield _by_object(GaugeMetricFamily, name, meaning, values)
        leaves = GaugeMetricFamily(
            "catstream_tree_leaves", "Leaves ever inserted into a coreset tree.", labels=["object", "tree"]
        )
        for tree in TREES:
            for name, value in dashboard.object_counters("compressor", f"{tree}_leaves").items():
                leaves.add_metric([name, tree], value)
        yield leaves

    def _processes(self) -> Iterator[Metric]:
        ages = GaugeMetricFamily(
            "catstream_health_age_seconds", "Seconds since the last health report of a process.", labels=["process"]
        )
        rejected = CounterMetricFamily(
            "catstream_rejected_messages", "Messages that do not conform to the protocol.", labels=["process"]
        )
        for process in CHANNELS["health"].senders:
            if process in self._feed.dashboard.health:
                ages.add_metric([process], max(0.0, time() - self._feed.dashboard.health[process].time))
                rejected.add_metric([process], self._feed.dashboard.counter(process, "rejected") or 0)
        yield from (ages, rejected)


def _by_object(
    kind: type[CounterMetricFamily] | type[GaugeMetricFamily], name: str, meaning: str, values: dict[str, float]
) -> Metric:
    """Return a metric with a value for each object, by name."""
    family = kind(f"catstream_{name}", meaning, labels=["object"])
    for each, value in values.items():
        family.add_metric([each], value)
    return family


def _gauge(name: str, meaning: str, value: float) -> Metric:
    return GaugeMetricFamily(f"catstream_{name}", meaning, value=float(value))

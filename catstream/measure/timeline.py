"""The figures of a load test over time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from catstream.measure.latency import REST, percentiles
from catstream.measure.load_result import Result

_MOST_INTERVALS = 3600
_ROUNDING = 1e-6  # tolerance in seconds for the due time of a frame at the begin of its interval


def timeline(result: Result) -> dict[str, list[float]]:
    """Return the figures of each second over all streams.

    Intervals are longer in a run of more than an hour, or below one frame per second, because each needs a frame.

    seconds            start of each interval, relative to the due time of the first frame
    p50, p95, p99      seconds from the frames that are due in the interval to their tracks
    tracks-p50 ...     seconds to their receipt by fast subscribers, for each channel
    skipped            share of the frames
    frames_per_second  tracked frames
    cores              mean number of busy cores, by the pipelines
    load_cores         ... by the camera, the subscribers and the load test
    other_cores        ... by other processes of the machine
    memory             bytes of the pipelines (PSS), read every five seconds
    """
    rate, streams, readings = result.plan.rate, result.streams, result.readings
    start = min(stream.due[0] for stream in streams)
    duration = max(stream.due[-1] for stream in streams) - start
    interval = max(int(duration) // _MOST_INTERVALS + 1, math.ceil(1 / rate))
    seconds = np.arange(0, duration + _ROUNDING, interval)

    def by_interval(measured: Iterable[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
        """Split arrays of values by their due times, with the frames along the last axis, into intervals."""
        ends = start + seconds[1:] - _ROUNDING
        parts = [np.split(values, np.searchsorted(due, ends), axis=-1) for due, values in measured]
        return [np.concatenate([part.ravel() for part in of_streams]) for of_streams in zip(*parts, strict=True)]

    # Step 1: latencies, at the load test and at its subscribers; and frames.
    latencies = {"": [(stream.due, stream.track) for stream in streams]}
    for each in result.subscribers:
        latencies.setdefault(f"{each.channel}-", []).append((streams[each.stream].due, each.latency))
    figures: dict[str, list[float]] = {"seconds": seconds.tolist()}
    for prefix, measured in latencies.items():
        rows = [percentiles(values) for values in by_interval(measured)]
        figures |= {prefix + name: [row[name] for row in rows] for name in ("p50", "p95", "p99")}
    tracked = by_interval((stream.due, stream.tracked) for stream in streams)
    figures["skipped"] = [1 - float(flags.mean()) for flags in tracked]
    figures["frames_per_second"] = [rate * len(streams) * (1 - share) for share in figures["skipped"]]

    # Step 2: processor and memory at the end of each interval, interpolated between the readings.
    def of_pipelines(amounts: Mapping[str, float]) -> float:
        return sum(amount for name, amount in amounts.items() if name[-1].isdigit())  # the number of the stream

    amounts = {
        "cores": [(each.moment, of_pipelines(each.cores)) for each in readings],
        "load_cores": [
            (each.moment, sum(each.cores.values()) - of_pipelines(each.cores) - each.cores[REST]) for each in readings
        ],
        "other_cores": [(each.moment, each.cores[REST]) for each in readings],
        "memory": [(each.moment, of_pipelines(each.memory)) for each in readings if each.memory],
    }
    ends = start + seconds + interval
    return figures | {name: np.interp(ends, *np.transpose(rows)).tolist() for name, rows in amounts.items()}

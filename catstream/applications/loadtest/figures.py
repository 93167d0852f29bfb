"""The figures of a load test as JSON."""

from __future__ import annotations

from catstream.applications.evaluation.provenance import provenance
from catstream.applications.loadtest.load_test import LoadTest
from catstream.applications.loadtest.measures import Measures
from catstream.applications.loadtest.usage import summary

__all__ = ["to_json"]


def to_json(load_test: LoadTest) -> dict[str, object]:
    """Return the figures of the decisive run, those of the search steps, and the provenance.

    Units are seconds, bytes, and shares from 0 to 1.
    """
    result = load_test.result
    plan = result.plan
    return {
        **provenance(plan.settings),
        "plan": {
            "streams": plan.streams,
            "objects": plan.objects,
            "subscribers": plan.subscribers,
            "slow_subscribers": plan.slow,
            "rate": plan.rate,
            "duration": plan.duration,
            "size": list(plan.size),
            "chaos": plan.chaos,
        },
        "seconds": result.seconds,
        "interrupted": load_test.interrupted,
        "latency": {"track": result.track.figures(), "model": result.model.figures()},
        "streams": [_stream(measures, plan.rate) for measures in result.streams],
        "processes": {name: summary(readings) for name, readings in result.usage.items()},
        "subscribers": {
            "quick": len(result.received),
            "received": sum(result.received),
            "missed": result.missed,
            "frozen_seconds": round(result.frozen, 3),
        },
        "chaos": [
            {
                "stream": recovery.kill.stream,
                "process": recovery.kill.process,
                "to_track": recovery.track,
                "to_model": recovery.model,
            }
            for recovery in result.recoveries
        ],
        "restarts": result.restarts,
        "camera_late": round(result.camera_late, 6),
        "limits": {limit.name: {"value": limit.value, "met": limit.is_met(result)} for limit in load_test.limits},
        "violations": load_test.violations,
        "highest_rate": load_test.highest_rate,
        "steps": [
            {
                "rate": step.rate,
                "followed": step.followed,
                "track": step.result.track.figures(),
                "violations": step.violations,
            }
            for step in load_test.steps
        ],
    }


def _stream(measures: Measures, rate: float) -> dict[str, object]:
    return {
        "frames": measures.frames,
        "frames_per_second": measures.rate(rate),
        "skipped": measures.skipped,
        "without_track": measures.without_track,
        "track": measures.track.figures(),
        "model": measures.model.figures(),
        "lag": measures.max_lag,
        "sent": measures.sent,
        "stored": measures.stored,
        "success": measures.success,
        "success_followed": measures.success_followed,
    }

"""All figures of a load test, as JSON holds them."""

from __future__ import annotations

from typing import Any

from catstream.evaluation.provenance import provenance
from catstream.loadtest.measures import Measures
from catstream.loadtest.trial import Trial
from catstream.loadtest.usage import summary

__all__ = ["to_json"]


def to_json(trial: Trial) -> dict[str, Any]:
    """The figures of the run that counts, of the steps that led to it, and what they were made with.

    Seconds, shares from 0 to 1, bytes.
    """
    result = trial.result
    plan = result.plan
    return {
        **provenance(plan.settings),
        "plan": {
            "streams": plan.streams,
            "subscribers": plan.subscribers,
            "slow_subscribers": plan.slow,
            "rate": plan.rate,
            "duration": plan.duration,
            "size": list(plan.size),
            "chaos": plan.chaos,
        },
        "seconds": result.seconds,
        "interrupted": trial.interrupted,
        "latency": {"track": result.track.figures(), "model": result.model.figures()},
        "streams": [_stream(measures, plan.rate) for measures in result.streams],
        "processes": {name: summary(samples) for name, samples in result.usage.items()},
        "subscribers": {
            "quick": len(result.heard),
            "heard": sum(result.heard),
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
        "limits": {limit.name: {"value": limit.value, "held": limit.held(result)} for limit in trial.limits},
        "broken": trial.broken,
        "found": trial.found,
        "steps": [
            {
                "rate": step.rate,
                "followed": step.followed,
                "track": step.result.track.figures(),
                "broken": step.broken,
            }
            for step in trial.steps
        ],
    }


def _stream(measures: Measures, rate: float) -> dict[str, Any]:
    return {
        "frames": measures.frames,
        "frames_per_second": measures.rate(rate),
        "skipped": measures.skipped,
        "never": measures.never,
        "track": measures.track.figures(),
        "model": measures.model.figures(),
        "lag": measures.most_lag,
        "sent": measures.sent,
        "stored": measures.stored,
        "success": measures.success,
        "success_followed": measures.success_followed,
    }

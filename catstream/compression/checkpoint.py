"""What a compressor's checkpoint holds besides the trees: the last sample, and the detector's state.

The trees grow on after a sample: only the sample itself gives a trainer that starts anew the
model that the detector goes by. Each is turned into arrays and facts for `storage`, and back.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from catstream.box import Box
from catstream.messages import DetectorState, Model, Motion, Sample, Summary

__all__ = ["detector_facts", "detector_of", "model_of", "model_state", "sample_of", "sample_state"]

State = tuple[dict[str, np.ndarray], dict[str, Any] | None]


def sample_state(sample: Sample | None) -> State:
    """Arrays and facts that `sample_of` makes this sample of again."""
    if sample is None:
        return {}, None
    arrays: dict[str, np.ndarray] = {"sample.centres": sample.centres}
    trees: dict[str, Any] = {}
    for name, summary in sample.trees.items():
        arrays |= {f"sample.{name}.rows": summary.rows, f"sample.{name}.mean": summary.mean}
        trees[name] = [summary.count, summary.levels]
    return arrays, {"version": sample.version, "frame": sample.frame, "trees": trees}


def sample_of(arrays: dict[str, np.ndarray], facts: dict[str, Any] | None) -> Sample | None:
    """The sample, bit for bit; KeyError, TypeError or ValueError where it is none."""
    if facts is None:
        return None
    trees: dict[str, Summary] = {}
    for name, (count, levels) in facts["trees"].items():
        rows, mean = arrays[f"sample.{name}.rows"], arrays[f"sample.{name}.mean"]
        trees[name] = Summary(rows, mean, int(count), tuple(levels))
    return Sample(int(facts["version"]), int(facts["frame"]), trees, arrays["sample.centres"])


def model_state(model: Model) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and facts that `model_of` makes this model of again."""
    arrays = {"weights": model.weights}
    arrays |= {f"heads.{name}": vector for name, vector in model.heads.items()}
    if model.motion is not None:
        arrays |= {"process": model.motion.process, "observation": model.motion.observation}
    return arrays, {"version": model.version, "frame": model.frame, "bias": model.bias}


def model_of(arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> Model:
    """The model, bit for bit; KeyError, TypeError or ValueError if it is none."""
    motion = Motion(arrays["process"], arrays["observation"]) if "process" in arrays else None
    heads = {name.removeprefix("heads."): array for name, array in arrays.items() if name.startswith("heads.")}
    version, frame = int(facts["version"]), int(facts["frame"])
    return Model(version, frame, arrays["weights"], float(facts["bias"]), motion, heads)


def detector_facts(detector: DetectorState | None) -> State:
    """Arrays and facts that `detector_of` makes this state of again."""
    if detector is None:
        return {}, None
    arrays: dict[str, np.ndarray] = {}
    if detector.motion is not None and detector.centre is not None:
        parts = {"process": detector.motion.process, "observation": detector.motion.observation}
        arrays = {f"detector.{name}": array for name, array in {**parts, "centre": detector.centre}.items()}
    if detector.balance is not None:
        arrays["detector.balance"] = detector.balance
    names = ("state", "window", "sure", "first", "usual", "elsewhere", "sightings")
    return arrays, {name: getattr(detector, name) for name in names}


def detector_of(arrays: dict[str, np.ndarray], facts: dict[str, Any] | None) -> DetectorState | None:
    """The state of the detector, bit for bit; KeyError, TypeError or ValueError where it is none."""
    if facts is None:
        return None
    motion, centre = None, arrays.get("detector.centre")
    if centre is not None:
        motion = Motion(arrays["detector.process"], arrays["detector.observation"])
    boxes = {name: facts[name] and Box(*facts[name]) for name in ("window", "sure", "first")}
    return DetectorState(**(facts | boxes), motion=motion, centre=centre, balance=arrays.get("detector.balance"))

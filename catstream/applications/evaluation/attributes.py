"""Attributes of annotated sequences: properties that make tracking in them difficult.

Five follow from the ground truth, as the benchmarks OTB and UAV123 define them:

    fast motion      the centre moves by more than 20 pixels from one frame to the next
    scale variation  the area is less than half or more than twice that of the first box
    aspect change    the aspect ratio is less than half or more than twice that of the first box
    low resolution   the area is less than 400 pixels
    out of view      the object is absent, or partly outside the frame

A sequence has an attribute if one of its frames has. Attributes that only people can see, for example occlusion, are
read from a JSON file: {"sequence": ["occlusion", "blur"]}.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec
import numpy as np

from catstream.applications.evaluation.datasets import Sequence
from catstream.errors import SettingsError
from catstream.numerics.arrays import Float64

_FAST = 20  # pixels a frame
_RATIO = 2
_SMALL = 400  # square pixels
_BORDER = 1  # pixels; the coordinates of some benchmarks start at 1


def attributes_of(sequences: Iterable[Sequence], others: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    """Return the names of the sequences that have each attribute. It reads a frame of each sequence.

    others : attributes of sequences by name, in addition to those that follow from the ground truth

    Raises
    ------
    VideoError
        If a frame cannot be read.
    """
    found: dict[str, list[str]] = {}
    for sequence in sequences:
        computed = computed_attributes(sequence.boxes, sequence.size())
        for attribute in dict.fromkeys([*computed, *others.get(sequence.name, ())]):
            found.setdefault(attribute, []).append(sequence.name)
    return dict(sorted(found.items()))


def computed_attributes(boxes: Float64, size: tuple[int, int]) -> list[str]:
    """Return the attributes that follow from the ground truth.

    Parameters
    ----------
    boxes : float64 (frames, 4), NaN if the object is absent; present in at least one frame
    size : width and height of the frames
    """
    present = np.isfinite(boxes).all(axis=1)
    known = boxes[present]
    centres = boxes[:, :2] + boxes[:, 2:] / 2
    moved = np.hypot(*np.diff(centres, axis=0).T)  # NaN beside a frame without the object
    areas, aspects = known[:, 2] * known[:, 3], known[:, 2] / known[:, 3]
    outside = (known[:, :2] < -_BORDER) | (known[:, :2] + known[:, 2:] > np.array(size) + _BORDER)
    has = {
        "fast motion": (moved > _FAST).any(),
        "scale variation": _changes(areas),
        "aspect change": _changes(aspects),
        "low resolution": (areas < _SMALL).any(),
        "out of view": not present.all() or outside.any(),
    }
    return [attribute for attribute, true in has.items() if true]


def _changes(values: Float64) -> bool:
    """Return whether a value is less than half or more than twice the first one."""
    ratios = values / values[0]
    return bool((ratios < 1 / _RATIO).any() or (ratios > _RATIO).any())


def read_attributes(file: Path) -> dict[str, list[str]]:
    """Read the attributes of sequences, {sequence: [attribute]}, from a JSON file.

    Raises
    ------
    SettingsError
        If it cannot be read, or has another form.
    """
    try:
        return msgspec.json.decode(file.read_bytes(), type=dict[str, list[str]])
    except (OSError, UnicodeDecodeError, msgspec.DecodeError) as error:
        raise SettingsError(
            f'cannot read the attributes in {str(file)!r} ({error}): give a JSON file {{"sequence": ["occlusion"]}}'
        ) from None

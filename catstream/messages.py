"""The facts that travel between the stages.

Each message is a noun, frozen, and complete by itself. In one process the
stages hand them over as they are; between processes `catstream.wire` turns
them into msgpack and back, and checks every field on arrival.

`d` is the length of a feature row (`catstream.features.cells.row_length`), `n`
the coreset size, frames count from 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, Literal

import numpy as np

from catstream.box import Box

__all__ = [
    "Answer",
    "Command",
    "DetectorState",
    "End",
    "Features",
    "Health",
    "Model",
    "Motion",
    "Position",
    "Preview",
    "Run",
    "Sample",
    "State",
    "Stored",
    "Summary",
    "Track",
    "Verb",
]

State = Literal["bootstrapping", "present", "absent"]

Verb = Literal["set-box", "pause", "resume", "save", "stop"]


@dataclass(frozen=True, slots=True)
class Motion:
    """Parameters of the Kalman filter of the centre, found by EM (paper, section "Classification").

    process      float64 (4, 4), covariance of what the constant-velocity model misses a frame
    observation  float64 (2, 2), covariance of a measured centre, pixels squared
    """

    process: np.ndarray
    observation: np.ndarray


@dataclass(frozen=True, slots=True)
class DetectorState:
    """What a detector needs to go on after a frame, besides the newest model.

    state      as in `Track`
    window     where it looks next
    sure       where it was when it was last sure
    first      where it was in its first frame, None while it was not found yet
    usual      score that the object usually has
    elsewhere  whether it was found by a search of the whole frame, and is not trusted yet
    motion     the Kalman filter's parameters, None before it has any
    centre     float64 (5, 4), the filter's mean (x, y, and their speeds) above its covariance; None before it has any
    balance    float64 (6,), where the object's colours lie in its window: frames taken in, contrast, the first
               centre's x and y, the present one's; None where nothing is known of it
    sightings  frames in a row in which an object that is not found yet was seen at one place
    """

    state: State
    window: Box
    sure: Box
    first: Box | None
    usual: float
    elsewhere: bool
    motion: Motion | None = None
    centre: np.ndarray | None = None
    balance: np.ndarray | None = None
    sightings: int = 0


@dataclass(frozen=True, slots=True)
class Features:
    """What one frame teaches: rows for the coreset trees, detector -> compressor.

    seq       1, 2, 3 ... without a gap: one message a frame
    frame     the frame the rows were cut from
    time      seconds since the start of the source, of a live one since that of the run
    box       where the object was found, or None
    rows      float32 (k, d); k is 0 where the frame teaches nothing
    labels    float32 (k,): 1 the object, 0 background, between them a near miss
    weights   float32 (k,): how many ordinary rows each counts for, above 0
    extents   float32 (s, d): the object cut as it is, too small, too large, too wide and too narrow; s may be 0
    fits      float32 (s,): how well each of those fits, 1 as it is, towards 0 far from it
    detector  from where a restarted detector goes on; None where the sender has none
    begins    whether another object begins here: what was learned before is forgotten
    """

    seq: int
    frame: int
    time: float
    box: Box | None
    rows: np.ndarray
    labels: np.ndarray
    weights: np.ndarray
    extents: np.ndarray
    fits: np.ndarray
    detector: DetectorState | None = None
    begins: bool = False


@dataclass(frozen=True, slots=True)
class Stored:
    """Acknowledges messages of an acknowledged channel, receiver -> sender.

    seq      every message up to and with this one survives the receiver's death, but for `unsaved`: forget it
    taken    every message up to and with this one has been taken
    version  the newest Sample made so far, 0 before the first
    unsaved  how many of those up to `seq`, the last ones, are in memory only: the disk takes nothing
    """

    seq: int
    taken: int
    version: int = 0
    unsaved: int = 0


@dataclass(frozen=True, slots=True)
class Position:
    """Where a stream goes on: a receiver's answer to each new connection.

    seq       the last message stored, 0 in a new stream: send from the next one on
    frame     its frame
    box       where the object was last found, None in a new stream
    version   the newest Sample made so far, 0 before the first
    detector  that of that message, None where it had none
    unsaved   how many of those up to `seq`, the last ones, are in memory only: the disk takes nothing
    """

    seq: int = 0
    frame: int = 0
    box: Box | None = None
    version: int = 0
    detector: DetectorState | None = None
    unsaved: int = 0


@dataclass(frozen=True, slots=True)
class Summary:
    """A hierarchical sample of one coreset tree (paper, section "Coreset Appearance Model").

    rows    float32 (r, d'), r <= 2n, spread and rescaled: a row weighs one original row
    mean    float32 (d',), the exact mean of all rows ever inserted
    count   how many rows that was
    levels  level of each node in memory, oldest first, strictly falling
    """

    rows: np.ndarray
    mean: np.ndarray
    count: int
    levels: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Sample:
    """What the trainer learns from, compressor -> trainer; only the newest counts.

    version     1, 2, 3 ... in order of making
    frame       newest frame that it summarises
    object      rows of the object (d columns)
    background  rows of everything else (d columns)
    loss        rows [x, 1, y] times the root of their weight (d + 2 columns)
    extent      rows [x, 1, y] of the object cut well and badly, None before a leaf of them (d + 2 columns)
    centres     float64 (m, 2), object's centre in the last whole block of frames, pixels, NaN where absent
    """

    version: int
    frame: int
    object: Summary
    background: Summary
    loss: Summary
    extent: Summary | None
    centres: np.ndarray


@dataclass(frozen=True, slots=True)
class Model:
    """A trained appearance model, trainer -> detector and anyone.

    version  that of the Sample it was learned from
    frame    newest frame that the sample summarises
    weights  float32 (d,)
    bias     score of a window = weights @ row + bias; 0 at the background's mean, 1 at the object's
    motion   parameters of the Kalman filter, or None before EM had enough centres
    extent   float32 (d,): of windows around one place, the one that fits the object best has the
             largest extent @ row; None before there was enough to learn it from
    """

    version: int
    frame: int
    weights: np.ndarray
    bias: float
    motion: Motion | None = None
    extent: np.ndarray | None = None


@dataclass(frozen=True, slots=True, repr=False)
class Track:
    """Where the object is in one frame, detector -> anyone.

    Attributes
    ----------
    seq : int
        1, 2, 3 ...: a gap means that this subscriber missed some.
    frame : int
        Number of the frame.
    time : float
        Seconds since the start of the source, of a live one since that of the run.
    state : str
        "bootstrapping" until the first model, then "present" or "absent".
    box : Box or None
        Where it is, in pixels of the frame; None while absent.
    score : float
        Confidence: about 0 on background, about 1 on the object.
    model_version : int
        The model that scored it, 0 before the first.
    pts : float or None
        Time stamp of the frame in a live stream, seconds of a clock of the stream's own; None of a file.

    Examples
    --------
    >>> Track(13, 12, 0.4, "present", Box(120.04, 80, 64, 48), 0.9314, 4)
    Track(frame=12, time=0.400, state='present', box=(120.0, 80.0, 64.0, 48.0), score=0.93, model_version=4)
    """

    seq: int
    frame: int
    time: float
    state: State
    box: Box | None
    score: float
    model_version: int
    pts: float | None = None

    def __repr__(self) -> str:
        box = None if self.box is None else f"({', '.join(f'{side:.1f}' for side in self.box)})"
        return (
            f"Track(frame={self.frame}, time={self.time:.3f}, state={self.state!r}, box={box}, score={self.score:.2f}, "
            f"model_version={self.model_version})"
        )

    def to_dict(self) -> dict[str, Any]:
        """The fields by name, of plain types for JSON: a box is a list [x, y, w, h], or None.

        `catstream sink FILE.ndjson` writes the same.

        Examples
        --------
        >>> Track(13, 12, 0.4, "absent", None, 0.12, 4).to_dict()["box"] is None
        True
        """
        return {
            "seq": int(self.seq),
            "frame": int(self.frame),
            "time": float(self.time),
            "state": self.state,
            "box": None if self.box is None else [float(side) for side in self.box],
            "score": float(self.score),
            "model_version": int(self.model_version),
            "pts": None if self.pts is None else float(self.pts),
        }


@dataclass(frozen=True, slots=True)
class Preview:
    """A small picture of a frame that was followed, or that waits for a box, detector -> anyone.

    frame   number of the frame
    width   of the frame in pixels; the picture may be smaller
    height  of the frame in pixels
    box     where the object was found in it, in pixels of the frame; None while absent, or before there is a box
    jpeg    the picture: a JPEG file, its sides in the proportion of the frame's
    """

    frame: int
    width: int
    height: int
    box: Box | None
    jpeg: bytes


@dataclass(frozen=True, slots=True)
class Health:
    """How a process is, once a second, every process -> anyone.

    process   its name
    time      seconds since the epoch
    counters  what it counts: name -> number
    trouble   what is wrong with it, for a person to read; empty where nothing is
    source    that the pipeline follows, without user and password; only the detector knows it
    """

    process: str
    time: float
    counters: dict[str, float] = field(default_factory=dict)
    trouble: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class Run:
    """What a pipeline runs with: with it, its features can be learned from again, detector -> anyone.

    program   version of catstream
    settings  name -> value of all settings but `run.endpoint` and `run.keys`, each as the text that `--set` takes
    """

    program: str
    settings: dict[str, str]

    @classmethod
    def of(cls, settings: dict[str, str]) -> Run:
        """A run of this version of catstream, with what `Settings.portable` returned."""
        return cls(version("catstream"), settings)


@dataclass(frozen=True, slots=True)
class End:
    """The last message of a stream: nothing follows.

    seq     one after the last message before it
    reason  why it ended, for a person to read
    failed  whether that was an error
    totals  what was counted: name -> number
    """

    seq: int
    reason: str
    failed: bool = False
    totals: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Command:
    """What somebody wants of a running pipeline, anyone -> detector.

    id    chosen anew for each command: one that comes twice is answered twice, and done once
    verb  what to do
    box   with "set-box": where the object is in the newest frame, in pixels
    keep  with "set-box": it is the same object, and what was learned of it is kept
    """

    id: str
    verb: Verb
    box: Box | None = None
    keep: bool = False


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of a Command, detector -> who sent it.

    id       that of the command
    done     whether it was carried out
    reason   what was done, or why nothing was, for a person to read
    frame    the newest frame that was followed by then
    box      where the object was last, or None
    version  the newest model of this object, 0 before the first
    """

    id: str
    done: bool
    reason: str
    frame: int = 0
    box: Box | None = None
    version: int = 0

"""The facts that travel between the stages.

Each message is a noun, frozen, and complete by itself. In one process the
stages hand them over as they are; between processes `catstream.wire` turns
them into msgpack and back, and checks every field on arrival.

The annotations are the schema (see `catstream.schema`), and the docstrings say what the fields mean: the checks of
the codec, the tables of `docs/protocol.md` and the fuzzers are derived from both.

`d` is the length of a feature row (`catstream.features.cells.row_length`), `n`
the coreset size, frames count from 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Annotated, Any, Literal, Self

import numpy as np

from catstream.box import Box, Window
from catstream.heads import GROUPS, HEADS
from catstream.schema import Array, Bytes, Named, OnlyWith, Whole

__all__ = [
    "Answer",
    "Command",
    "DetectorState",
    "End",
    "Features",
    "Health",
    "Level",
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
    "TrainingRows",
    "Verb",
]

State = Literal["bootstrapping", "present", "absent"]

Level = Literal["lost", "redetected", "weak", "confident"]

Verb = Literal["set-box", "pause", "resume", "save", "stop"]

_COLUMNS = {name: head.more_columns for name, head in HEADS.items()}
_REQUIRED = frozenset(name for name, head in HEADS.items() if head.adds_to_score)
_BESIDE = {name: 0 for name in HEADS if name not in _REQUIRED}


@dataclass(frozen=True, slots=True)
class Motion:
    """Parameters of the Kalman filter of the centre, found by EM (paper, section "Classification").

    process      covariance of what the constant-velocity model misses in a frame; of x, y, then their speeds
    observation  covariance of a measured centre, pixels squared
    """

    process: Annotated[np.ndarray, Array("float64", (4, 4))]
    observation: Annotated[np.ndarray, Array("float64", (2, 2))]


@dataclass(frozen=True, slots=True)
class DetectorState:
    """All that a detector knows after a frame, besides the model: with both, another one goes on bit for bit.

    first_frame       the object's first; a model of frames before it is of another object
    level             of the belief that the object was found, see `catstream.detection.belief`
    window            where the object was; the next search begins there
    confident_window  the same in the last frame in which the belief was confident
    first_window      the same in the first frame; None while the object of a saved model has not been found
    trusted           false after the object was found again elsewhere in the frame, until its score is high
    usual_score       running mean of the score in the frames in which the object was present
    sightings         frames in a row in which the object of a saved model was seen in one place
    motion            of the Kalman filter of the centre, None before a model had any
    centre            its estimate: mean (x, y, and their speeds) above covariance; None before it has one
    colour_centroid   where in the window the object's colours are: frames taken in, contrast, x and y at first, x and y
                      now; None before the first of these frames
    """

    first_frame: int
    level: Level
    window: Window
    confident_window: Window
    first_window: Window | None
    trusted: bool = True
    usual_score: float = 0.0
    sightings: int = 0
    motion: Motion | None = None
    centre: Annotated[np.ndarray, Array("float64", (5, 4))] | None = None
    colour_centroid: Annotated[np.ndarray, Array("float64", (6,))] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TrainingRows:
    """Feature rows of windows of a frame, with the label that each should get.

    rows     features of the windows
    labels   of group "appearance" 1 the object, 0 background, between them a near miss; of group "extent" how well
             the cut fits: 1 the right size and aspect, towards 0 far from them
    weights  how many ordinary rows each counts for
    """

    rows: Annotated[np.ndarray, Array("float32", ("k", "d"))]
    labels: Annotated[np.ndarray, Array("float32", ("k",), low=0, high=1)]
    weights: Annotated[np.ndarray, Array("float32", ("k",), above=0)]

    @classmethod
    def of(cls, rows: Sequence[np.ndarray], label: float | Sequence[float], weight: float = 1.0) -> Self:
        """Rows of one weight, with one label or each its own."""
        k = len(rows)
        return cls(np.array(rows, np.float32), np.full(k, label, np.float32), np.full(k, weight, np.float32))

    def __len__(self) -> int:
        return len(self.rows)

    def __add__(self, other: TrainingRows) -> TrainingRows:
        return TrainingRows(
            np.concatenate([self.rows, other.rows]),
            np.concatenate([self.labels, other.labels]),
            np.concatenate([self.weights, other.weights]),
        )


@dataclass(frozen=True, slots=True)
class Features:
    """What one frame teaches: rows for the coreset trees, detector -> compressor.

    seq       1, 2, 3 ... without a gap: one message a frame
    frame     the frame the rows were cut from
    time      seconds since the start of the source, of a live one since that of the run
    box       where the object was found, or None
    training  by group, see `catstream.heads`; a group without rows is left out
    detector  from where a restarted detector goes on; None where the sender has none
    begins    whether another object begins here: what was learned before is forgotten
    """

    seq: int
    frame: int
    time: float
    box: Box | None
    training: Annotated[dict[str, TrainingRows], Named(dict.fromkeys(GROUPS, 0))] = field(default_factory=dict)
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

    rows    at most 2n, spread and rescaled: each weighs one original row
    mean    exact mean of all rows ever inserted
    count   how many rows that was
    levels  level of each node in memory, oldest first, strictly falling
    """

    rows: Annotated[np.ndarray, Array("float32", ("r", "d"))]
    mean: Annotated[np.ndarray, Array("float32", ("d",))]
    count: int
    levels: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Sample:
    """What the trainer learns from, compressor -> trainer; only the newest counts.

    version  1, 2, 3 ... in order of making
    frame    newest frame that it summarises
    trees    by head, see `catstream.heads`; a tree without a leaf is left out
    centres  centre of the object in each frame of the last whole block of frames, pixels; NaN while absent
    """

    version: int
    frame: int
    trees: Annotated[dict[str, Summary], Named(_COLUMNS, _REQUIRED)]
    centres: Annotated[np.ndarray, Array("float64", ("m", 2), may_be_nan=True)]


@dataclass(frozen=True, slots=True)
class Model:
    """A trained appearance model, trainer -> detector and anyone.

    version  that of the Sample it was learned from
    frame    newest frame that the sample summarises
    weights  score of a window = weights @ row + bias
    bias     so that the score is 0 at the background's mean and 1 at the object's
    motion   parameters of the Kalman filter, or None before EM had enough centres
    heads    vectors of the heads that do not add to the score, as far as they are trained: of windows around one
             place, the one that fits the object best has the largest (weights + heads["extent"]) @ row
    """

    version: int
    frame: int
    weights: Annotated[np.ndarray, Array("float32", ("d",))]
    bias: float
    motion: Motion | None = None
    heads: Annotated[dict[str, Annotated[np.ndarray, Array("float32", ("d",))]], Named(_BESIDE)] = field(
        default_factory=dict
    )


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
    width: Annotated[int, Whole(low=1)]
    height: Annotated[int, Whole(low=1)]
    box: Box | None
    jpeg: Annotated[bytes, Bytes("a JPEG", longest=1 << 19, begin=b"\xff\xd8\xff")]


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
    box: Annotated[Box | None, OnlyWith("verb", "set-box")] = None
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

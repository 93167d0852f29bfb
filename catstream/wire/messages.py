"""The messages between the stages.

A message is frozen and self-contained. Within one process, the stages pass the message objects. Between processes,
`catstream.wire` encodes them with msgpack, and validates every field on arrival.

The annotations are the schema (see `catstream.wire.schema`), and the docstrings describe the fields. The checks,
the files of `catstream.wire.storage`, the tables of `docs/protocol.md` and the fuzzers are derived from both.

`d` is the length of a feature row (`catstream.features.layout.ROW_LENGTH`), `n` the coreset size, frames count from 0.
The objects of a stream have names (`catstream.base.names`); a single object may have the name "".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Self

import msgspec
import numpy as np
from msgspec import Meta

from catstream.base.box import Box, Window
from catstream.errors import ProtocolError
from catstream.wire.heads import GROUPS, HEADS, TREES
from catstream.wire.schema import (
    LARGEST_INTEGER,
    LONGEST_LIST,
    Array,
    ByObject,
    ByText,
    Integer,
    Named,
    Number,
    ObjectName,
    Text,
)

State = Literal["bootstrapping", "present", "absent"]

Check = Literal["", "keyframe", "hidden", "checked", "unchecked"]

Level = Literal["lost", "redetected", "weak", "confident"]

Verb = Literal["set-box", "search", "forget", "pause", "resume", "save", "stop"]

#: Maximum size of a saved model, in bytes.
LARGEST_MODEL = 511 << 20

#: Maximum size of a saved model with which an object begins, in bytes.
LARGEST_INITIAL_MODEL = 63 << 20

#: Maximum total size of the models with which objects begin in one frame, in bytes: one message contains them.
LARGEST_INITIAL_MODELS = 200 << 20

#: The state of a run, see `run_state`: "lost" is its source, "waiting" is for a box.
RunState = Literal["running", "lost", "waiting", "paused", "ended"]

#: The state of a stream of a fleet: the state of its run, or why it has none.
StreamState = Literal["starting", "running", "lost", "waiting", "paused", "moving", "stopping", "failed", "ended"]

NodeState = Literal["alive", "dead"]

_COLUMNS = {name: tree.more_columns for name, tree in TREES.items()}
_REQUIRED = frozenset(name for name, tree in TREES.items() if tree.required)
_NOT_IN_THE_SCORE = {name: 0 for name, head in HEADS.items() if not head.adds_to_score}
_WITH_BIAS = {name: 0 for name, head in HEADS.items() if head.has_bias}


@dataclass(frozen=True, slots=True)
class Motion:
    """Parameters of the Kalman filter of the centre, estimated by EM (paper, section "Classification").

    process      process noise covariance per frame of the constant-velocity model: x, y, then their speeds
    observation  covariance of a measured centre, pixels squared
    """

    process: Annotated[np.ndarray, Array("float64", (4, 4))]
    observation: Annotated[np.ndarray, Array("float64", (2, 2))]


@dataclass(frozen=True, slots=True)
class DetectorState:
    """The state of a detector after a frame. With it and the model, another detector continues bit for bit.

    first_frame       number of the object's first frame
    level             level of belief in the detection
    window            window of the object, the centre of the next search
    confident_window  window of the last confident frame; the best one while a saved model's object is searched for
    first_window      window of the first frame, None while a saved model's object is searched for
    trusted           false after a detection elsewhere, until the score is high
    sightings         successive frames with a saved model's object at one position
    motion            parameters of the Kalman filter, None before the first
    centre            its state, None before the first: mean (x, y, and their speeds) above covariance
    together          first frame of each earlier object whose box has always overlapped this one, by name
    """

    first_frame: Integer
    level: Level
    window: Window
    confident_window: Window
    first_window: Window | None = None
    trusted: bool = True
    sightings: Integer = 0
    motion: Motion | None = None
    centre: Annotated[np.ndarray, Array("float64", (5, 4))] | None = None
    together: ByObject[Integer] = field(default_factory=dict)

    @property
    def is_searched(self) -> bool:
        """True while a saved model's object is searched for: it was not detected yet."""
        return self.first_window is None


@dataclass(frozen=True, slots=True, eq=False)
class TrainingRows:
    """Feature rows of windows of a frame, each with its label and weight.

    rows     features of the windows
    labels   1 for the object, or in the group "extent" for the right size and aspect; 0 for background; between them
             for a near miss
    weights  number of ordinary rows that each row counts as
    offsets  group "extent": 0.5 for the right size, plus 1/16 for each step above it, and the same for the aspect;
             None if all are right
    """

    rows: Annotated[np.ndarray, Array("float32", ("k", "d"))]
    labels: Annotated[np.ndarray, Array("float32", ("k",), low=0, high=1)]
    weights: Annotated[np.ndarray, Array("float32", ("k",), above=0)]
    offsets: Annotated[np.ndarray, Array("float32", ("k", 2), low=0, high=1)] | None = None

    @classmethod
    def labelled(cls, rows: np.ndarray, label: float | Sequence[float], weight: float = 1.0) -> Self:
        """Rows of equal weight, with one label for all or one each."""
        k = len(rows)
        return cls(np.asarray(rows, np.float32), np.full(k, label, np.float32), np.full(k, weight, np.float32))

    def __len__(self) -> int:
        return len(self.rows)

    def __add__(self, other: TrainingRows) -> TrainingRows:
        """Concatenate the rows of a group without offsets."""
        return TrainingRows(
            np.concatenate([self.rows, other.rows]),
            np.concatenate([self.labels, other.labels]),
            np.concatenate([self.weights, other.weights]),
        )


@dataclass(frozen=True, slots=True)
class ObjectFeatures:
    """The part of `Features` for one object.

    box       box of the object, None if it was not found
    training  rows of each non-empty group
    detector  state of the detector after this frame, None before the first
    begins    whether a new object begins under this name, with empty trees
    model     saved model with which the object begins, otherwise empty
    """

    box: Box | None
    training: Annotated[dict[str, TrainingRows], Named(dict.fromkeys(GROUPS, 0))] = field(default_factory=dict)
    detector: DetectorState | None = None
    begins: bool = False
    model: Annotated[bytes, Meta(max_length=LARGEST_INITIAL_MODEL)] = b""


class _Numbered:
    """A message of a frame."""

    __slots__ = ()
    frame: int

    @property
    def seq(self) -> int:
        """Number of the message in its channel: 1, 2, 3 ..."""
        return self.frame + 1


@dataclass(frozen=True, slots=True)
class Features(_Numbered):
    """The training rows of one frame, detector -> compressor; one message a frame.

    frame    number of the frame: 0, 1, 2 ... without a gap
    time     time of the frame in seconds
    objects  the part of each object that is tracked, by name
    """

    frame: Integer
    time: Number
    objects: ByObject[ObjectFeatures]


@dataclass(frozen=True, slots=True)
class Position:
    """Acknowledgement of messages, receiver -> sender. The message of frame n has number n + 1.

    seq        newest acknowledged message: the sender drops its copies up to this one
    processed  newest processed message
    in_memory  number of acknowledged messages that are in memory only, because the disk is not writable
    versions   version of the newest sample of each object
    again      whether the sender must retransmit all messages after `processed`
    states     for a restarted sender: state of each object's detector after the requested message, or after the nearest
               known one
    """

    seq: Integer = 0
    processed: Integer = 0
    in_memory: Integer = 0
    versions: ByObject[Integer] = field(default_factory=dict)
    again: bool = False
    states: ByObject[DetectorState] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Summary:
    """A hierarchical sample of one coreset tree (paper, section "Coreset Appearance Model").

    rows    at most 2n rows, rotated and rescaled to the weight of one original row each
    mean    exact mean of all inserted rows
    count   number of inserted rows
    levels  level of each node, oldest first, strictly decreasing
    """

    rows: Annotated[np.ndarray, Array("float32", ("r", "d"))]
    mean: Annotated[np.ndarray, Array("float32", ("d",))]
    count: Integer
    levels: Annotated[tuple[Integer, ...], Meta(max_length=LONGEST_LIST)]


@dataclass(frozen=True, slots=True)
class Sample:
    """A training sample of all frames so far, compressor -> trainer; the newest of each object replaces older ones.

    version  1, 2, 3 ... over the samples of all objects
    frame    number of the newest summarised frame
    trees    summary of each tree that has a leaf
    centres  centres of the object in the last complete block of frames, pixels; NaN while absent
    object   name of the object
    began    number of the object's first frame
    """

    version: Integer
    frame: Integer
    trees: Annotated[dict[str, Summary], Named(_COLUMNS, _REQUIRED)]
    centres: Annotated[np.ndarray, Array("float64", ("m", 2), may_be_nan=True)]
    object: ObjectName = ""
    began: Integer = 0


@dataclass(frozen=True, slots=True)
class Model:
    """A trained appearance model, trainer -> detector and anyone.

    version  version of the sample
    frame    number of the newest frame in the sample
    weights  weights of the score of a window: weights @ row + bias
    bias     such that the mean of the background scores 0, and the mean of the object 1
    motion   parameters of the Kalman filter, None before the first EM
    heads    vector of each trained head that does not add to the score. A window fits well if
             (weights + heads["extent"]) @ row is high, and heads[name] @ row + biases[name] is near 0.5 for "size" and
             "aspect"
    biases   bias of each of these heads, if it has a bias
    object   name of the object
    began    number of the object's first frame
    """

    version: Integer
    frame: Integer
    weights: Annotated[np.ndarray, Array("float32", ("d",))]
    bias: Number
    motion: Motion | None = None
    heads: Annotated[dict[str, Annotated[np.ndarray, Array("float32", ("d",))]], Named(_NOT_IN_THE_SCORE)] = field(
        default_factory=dict
    )
    biases: Annotated[dict[str, float], Named(_WITH_BIAS)] = field(default_factory=dict)
    object: ObjectName = ""
    began: Integer = 0


@dataclass(frozen=True, slots=True, repr=False)
class Track(_Numbered):
    """An object in one frame, detector -> anyone.

    frame          number of the tracked frame, from 0, the same for all objects. A gap means that messages were missed
                   or that the object was not tracked
    time           seconds since the start of the source, or of the run if the source is live
    state          "absent" without a box, "bootstrapping" with the model of the first frame (version 0), then "present"
    box            box of the object, in pixels of the frame; None while absent
    score          confidence: about 0 on background, about 1 on the object
    model_version  version of the model of the score, 0 before the first
    pts            time stamp of a live stream, in seconds of its own clock; None for a file or without a stamp
    object         name of the object
    began          number of the object's first frame. A different number means a new object of the same name
    doubtful       whether the box should be checked: the level of belief is "weak" or "redetected"
    source_frame   number of the frame in its file or folder: start + stride * frame; `frame` for a live source
    checked        in an annotation: "keyframe" with a drawn box, "hidden" if marked as hidden by a person and the box
                   is estimated, "checked" if both directions agree, else "unchecked"
    probability    in an annotation: probability that the box, or its absence, is right

    >>> Track(12, 0.4, "present", Box(120.04, 80, 64, 48), 0.9314, 4)
    Track(frame=12, time=0.400, state='present', box=(120.0, 80.0, 64.0, 48.0), score=0.93, model_version=4)
    """

    frame: Integer
    time: Number
    state: State
    box: Box | None
    score: Number
    model_version: Integer
    pts: Number | None = None
    object: ObjectName = ""
    began: Integer = 0
    doubtful: bool = False
    source_frame: Integer = -1
    checked: Check = ""
    probability: Number | None = None

    def __post_init__(self) -> None:
        if self.source_frame < 0:
            object.__setattr__(self, "source_frame", self.frame)

    def __repr__(self) -> str:
        name = f"object={self.object!r}, " if self.object else ""
        box = None if self.box is None else f"({', '.join(f'{side:.1f}' for side in self.box)})"
        return (
            f"Track({name}frame={self.frame}, time={self.time:.3f}, state={self.state!r}, box={box}, "
            f"score={self.score:.2f}, model_version={self.model_version})"
        )

    def to_dict(self) -> dict[str, Any]:
        """The fields by name, with the types of JSON, as in FILE.ndjson: a box is a list [x, y, w, h], or None.

        Only annotations have `checked` and `probability`.

        >>> Track(12, 0.4, "absent", None, 0.12, 4).to_dict()["box"] is None
        True
        """
        values: dict[str, Any] = msgspec.to_builtins(self, enc_hook=lambda number: number.item())  # NumPy scalars
        if self.box is not None:
            values["box"] = list(values["box"])
        if not self.checked:
            del values["checked"], values["probability"]
        return values


@dataclass(frozen=True, slots=True)
class Tracks(_Numbered):
    """The tracks of one frame, detector -> owner (the program that started the run); one message a frame.

    frame   number of the frame: 0, 1, 2 ... without a gap
    tracks  the track of each object
    """

    frame: Integer
    tracks: ByObject[Track]


@dataclass(frozen=True, slots=True)
class Preview:
    """A small picture of a frame, detector -> anyone.

    frame   number of the frame
    time    time of the frame, as in its track
    width   width of the frame in pixels; the picture may be smaller
    height  height of the frame in pixels
    boxes   box of each present object, in pixels of the frame
    jpeg    picture as a JPEG file, with the frame's aspect ratio
    """

    frame: Integer
    time: Number
    width: Annotated[int, Meta(ge=1, le=LARGEST_INTEGER)]
    height: Annotated[int, Meta(ge=1, le=LARGEST_INTEGER)]
    boxes: ByObject[Box]
    jpeg: Annotated[bytes, Meta(max_length=1 << 19)]

    def __post_init__(self) -> None:
        if not self.jpeg.startswith(b"\xff\xd8\xff"):
            raise ProtocolError("preview: expected a picture as a JPEG file")


@dataclass(frozen=True, slots=True)
class ModelFile:
    """The trees and the model of an object, compressor -> anyone.

    version  version of the object's newest sample
    file     file that `catstream save` writes: all coreset trees, and a model
    object   name of the object
    """

    version: Integer
    file: Annotated[bytes, Meta(max_length=LARGEST_MODEL)]
    object: ObjectName = ""


@dataclass(frozen=True, slots=True)
class Health:
    """The condition of a process, once a second, every process -> anyone.

    process   name of the process
    time      seconds since the epoch (1970)
    counters  counters of the process
    trouble   description of a problem, empty if there is none
    source    of the detector: video source without user and password
    objects   counters of each object; `score` and `present` only while frames are tracked
    state     of the detector: "running" while frames are tracked, "lost" without a source, "waiting" for a box
    """

    process: Text
    time: Number
    counters: ByText[Number] = field(default_factory=dict)
    trouble: Text = ""
    source: Text = ""
    objects: ByObject[ByText[Number]] = field(default_factory=dict)
    state: RunState | None = None


def run_state(counters: Mapping[str, float]) -> tuple[RunState, str]:
    """The state of a run by the counters of its detector: the first that applies, and a description of all.

    Commands, the page and /readyz all show this state.

    >>> run_state({"lost_seconds": 12.3, "paused": 1.0})
    ('lost', 'source lost for 12 s, paused')
    """
    if counters.get("ended"):
        return "ended", "ended"
    states: dict[RunState, str] = {}
    if lost := counters.get("lost_seconds"):
        states["lost"] = f"source lost for {lost:.0f} s"
    if counters.get("waiting"):
        states["waiting"] = "waiting for a box"
    if counters.get("paused"):
        states["paused"] = "paused"
    return next(iter(states), "running"), ", ".join(states.values()) or "running"


@dataclass(frozen=True, slots=True)
class End(_Numbered):
    """The last message of a stream.

    frame   number of the last frame, plus one
    reason  why the stream ended
    failed  whether it ended with an error
    totals  final counters: `sent` and `stored` features messages, `damaged`, `scaled` and `skipped` frames,
            `truncated` seconds of a file, `reconnects` of a live source
    """

    frame: Integer
    reason: Text
    failed: bool = False
    totals: ByText[Number] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Command:
    """A control command to a running pipeline, anyone -> detector.

    id       unique for each command. A command that is received twice is executed once and answered twice
    verb     the action
    box      "set-box": box of the object in the next tracked frame; in a paused file, in the current frame
    keep     "set-box": whether the object keeps its trees and model, because it is the same object
    object   "set-box", "search", "forget", "save": name of the object
    model    "search": saved model of the object, which is searched for from the next frame on
    seconds  "pause": time after which the pause ends unless the command is repeated; 0 ends it now. None: until
             "resume"
    time     "set-box" on a live source: time of the preview in which the box was drawn. While its frame is kept, the
             object is searched for from there to the next tracked frame
    boxes    "set-box", in place of `box` and `object`: boxes of several objects that begin in one frame
    """

    id: Text
    verb: Verb
    box: Box | None = None
    keep: bool = False
    object: ObjectName = ""
    model: Annotated[bytes, Meta(max_length=LARGEST_INITIAL_MODEL)] | None = None
    seconds: Number | None = None
    time: Number | None = None
    boxes: ByObject[Box] = field(default_factory=dict)

    def __post_init__(self) -> None:
        boxes = bool(self.boxes) + (self.box is not None)
        for name, verb, count in (("box", "set-box", boxes), ("model", "search", self.model is not None)):
            if count != (self.verb == verb):
                raise ProtocolError(f"command: expected a {name} with {verb} and with nothing else, got {self.verb!r}")


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a Command, detector -> its sender.

    id       id of the command
    done     whether it was executed
    reason   the effect, or the reason of the rejection
    frame    number of the newest processed frame
    box      last box of the object, None if there is none
    version  version of the object's newest model, 0 before the first
    object   name of the object
    """

    id: Text
    done: bool
    reason: Text
    frame: Integer = 0
    box: Box | None = None
    version: Integer = 0
    object: ObjectName = ""


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """The state and the location of one stream of a fleet.

    name            name of the stream, unique in its fleet
    state           "waiting" for a box, "moving" between nodes, "stopping" if it was removed from the fleet
    node            name of its node, empty if it runs on none
    source          video source without user and password
    endpoint        endpoint of its pipeline, as in `run.endpoint`; empty if it does not run
    server          public key of its sockets, empty without keys
    token           fencing token, larger for each new pipeline of the stream
    live            whether the source is live: lost frames are not repeated, and their numbers are reused
    frame           number of the newest tracked frame
    skipped         frames of a live source that were skipped because the pipeline was too slow
    missed          frames or events that its destinations have missed since its pipeline was started
    models          version of the newest model of each object
    present         whether each object is present in that frame; empty if no frames are tracked
    stored_seconds  seconds since the store had the newest state, None without one
    trouble         description of a problem, empty if there is none
    """

    name: str
    state: StreamState
    node: str = ""
    source: str = ""
    endpoint: str = ""
    server: str = ""
    token: int = 0
    live: bool = False
    frame: int = 0
    skipped: int = 0
    missed: int = 0
    models: dict[str, int] = field(default_factory=dict)
    present: dict[str, bool] = field(default_factory=dict)
    stored_seconds: float | None = None
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """The state of one node of a fleet.

    name     name of the node, unique in its fleet
    state    "dead" if it does not answer Ray
    address  name or address of the machine
    cores    processor cores that streams may use
    used     cores reserved for its streams
    labels   labels of the node, by name
    streams  number of streams on it
    """

    name: str
    state: NodeState
    address: str = ""
    cores: float = 0.0
    used: float = 0.0
    labels: dict[str, str] = field(default_factory=dict)
    streams: int = 0


@dataclass(frozen=True, slots=True)
class FleetStatus:
    """The state of a fleet.

    name     name of the fleet
    time     seconds since the epoch (1970)
    streams  state of each stream, by name
    nodes    state of each node, by name
    """

    name: str
    time: float
    streams: dict[str, StreamStatus] = field(default_factory=dict)
    nodes: dict[str, NodeStatus] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Question:
    """A question about the streams and nodes of a fleet, anyone -> controller of the fleet.

    id      unique for each question
    stream  name of one stream; empty for all streams and nodes
    """

    id: Text
    stream: Text = ""


@dataclass(frozen=True, slots=True)
class Listing:
    """The answer to a Question, controller of the fleet -> its sender.

    id      id of the question
    fleet   state of the fleet, or of the one stream, as JSON
    """

    id: Text
    fleet: Annotated[bytes, Meta(max_length=15 << 20)]

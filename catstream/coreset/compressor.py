"""The compressor of one object: inserts its features of every frame into coreset trees, and samples them periodically.

It owns the coreset trees of its object, one for each row of `catstream.wire.heads.TREES`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from hashlib import blake2b

import numpy as np

from catstream.base.arrays import Bool, Float32
from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.coreset.tree import CoresetTree, pack_trees, unpack_trees
from catstream.errors import SettingsError
from catstream.wire.heads import APPEARANCE, TREES, Tree
from catstream.wire.messages import DetectorState, ObjectFeatures, Sample, TrainingRows
from catstream.wire.storage import Arrays, Metadata, pack, unpack

#: Frames between two samples on which a model is trained, fewer while the trees are small; 5 track no better.
SAMPLE_INTERVAL = 8
#: Frames in a block of centres from which EM learns the parameters of the Kalman filter: enough for its covariances.
MOTION_FRAMES = 64

_NO_OFFSET = 0.5  # label of a window of the right size and aspect ratio
_GROWTH = 9 / 8  # growth of the number of leaves that ends an interval early


class Compressor:
    """Summarises all frames so far of one object, and returns a sample when its trees have grown enough.

    Constant time a frame on average, logarithmic memory. The same features make the same samples, bit for bit, also
    across `state` and `from_state`.
    """

    def __init__(self, settings: Settings, name: str = "") -> None:
        if settings.coreset.share:
            raise SettingsError(
                f"coreset.share={settings.coreset.share:g} is a share of a video's length: "
                "call Settings.for_length first, or set coreset.size"
            )
        self.settings, self.name = settings, name
        self.trees = {name: CoresetTree(settings.coreset.size) for name in TREES}
        self.began, self.frame = 0, -1  #: numbers of the object's first frame in this stream, and of the newest frame
        self.box: Box | None = None  #: of the last detection
        self.detector: DetectorState | None = None  #: after the newest frame, for a restarted detector
        self.last_sample: Sample | None = None
        self.centres = np.empty((0, 2))  #: the newest complete block
        self._path: list[tuple[float, float]] = []  # the next block
        self._sampled_leaves = 0  # 0 before the first sample
        self._origin = ""  # digest of the first training rows in this stream, empty before them
        self._earlier: tuple[str, ...] = ()  # origins of the streams that the trees continue

    @classmethod
    def continuing(
        cls,
        trees: Mapping[str, CoresetTree],
        version: int,
        centres: np.ndarray,
        origins: tuple[str, ...],
        settings: Settings,
        name: str = "",
    ) -> Compressor:
        """Continue copies of the trees of an earlier stream with another stream; call `begin` next."""
        self = cls(settings, name)
        self.trees = {kind: tree.copy() for kind, tree in trees.items()}
        self.last_sample, self.centres = sample_of(self.trees, version, 0, centres, name), centres
        self._sampled_leaves, self._earlier = self.leaves, origins
        return self

    def begin(self, frame: int, version: int) -> Sample | None:
        """Begin the object's stream at a frame; returns the sample of the trees of an earlier stream, or None.

        The sample gets `version`, the next one of this stream, unless its own version is higher.
        """
        self.began = frame
        if self.last_sample is not None:
            self.last_sample = replace(self.last_sample, version=max(self.version, version), frame=frame, began=frame)
        return self.last_sample

    @property
    def width(self) -> int:
        """Length d of a feature row, 0 before the first."""
        widths = {self.trees[name].width - tree.more_columns for name, tree in TREES.items() if self.trees[name].width}
        return max(widths, default=0)

    def take(self, frame: int, features: ObjectFeatures, version: int) -> Sample | None:
        """Insert the features of one frame; returns a sample if the trees have grown enough since the last one."""
        # Step 1: insert the training rows into the trees of their group.
        if not self._origin and APPEARANCE in features.training:
            self._origin = blake2b(features.training[APPEARANCE].rows.tobytes(), digest_size=8).hexdigest()
        for name, tree in TREES.items():
            if (training := features.training.get(tree.group)) is not None:
                self.trees[name].extend(_rows_of(tree, training))
        self.frame, self.detector = frame, features.detector
        if features.box is not None:
            self.box = features.box
        # Step 2: append the centre. Samples contain complete blocks of centres, so motion is trained once per block.
        self._path.append(features.box.centre if features.box else (np.nan, np.nan))
        if len(self._path) == MOTION_FRAMES:
            self.centres, self._path = np.array(self._path), []
        # Step 3: sample if there is a new leaf, and the trees have grown by an eighth or the interval is over.
        if not all(self.trees[name].nodes for name, tree in TREES.items() if tree.required):
            return None
        leaves = self.leaves
        last_frame = self.last_sample.frame if self.last_sample is not None else math.inf
        has_grown = leaves >= _GROWTH * self._sampled_leaves or frame - last_frame >= SAMPLE_INTERVAL
        if leaves <= self._sampled_leaves or not has_grown:
            return None
        self._sampled_leaves = leaves
        self.last_sample = sample_of(self.trees, version, frame, self.centres, self.name, self.began)
        return self.last_sample

    @property
    def version(self) -> int:
        """Version of the last sample, 0 before the first."""
        return self.last_sample.version if self.last_sample else 0

    @property
    def leaves(self) -> int:
        """Number of leaves that were inserted into the trees."""
        return sum(tree.leaves for tree in self.trees.values())

    @property
    def origins(self) -> tuple[str, ...]:
        """Digest of the first training rows of each stream that the trees contain, oldest stream first."""
        return (*self._earlier, self._origin) if self._origin else self._earlier

    def counters(self) -> dict[str, float]:
        """Counters for the health messages."""
        return {
            "version": self.version,
            "rows": sum(tree.rows_seen for tree in self.trees.values()),
            "leaves": self.leaves,
            **{f"{name}_leaves": tree.leaves for name, tree in self.trees.items()},
            "level": max((node.level for tree in self.trees.values() for node in tree.nodes), default=0),
            "nodes": sum(len(tree.nodes) for tree in self.trees.values()),
            "bytes": sum(tree.nbytes for tree in self.trees.values()),
        }

    def state(self) -> tuple[Arrays, Metadata]:
        """Arrays and metadata that `from_state` restores."""
        arrays, trees = pack_trees(self.trees)
        arrays |= {"centres": self.centres, "path": np.array(self._path).reshape(-1, 2)}
        metadata: Metadata = {
            "began": self.began,
            "frame": self.frame,
            "box": list(self.box) if self.box else None,
            "sampled_leaves": self._sampled_leaves,
            "trees": trees,
            "origin": self._origin,
            "earlier": list(self._earlier),
        }
        # The trees have grown since the last sample, which is stored for a restarted trainer: it trains the model that
        # the detector uses.
        for name, message in (("sample", self.last_sample), ("detector", self.detector)):
            if message is not None:
                own, metadata[name] = pack(message, name)
                arrays |= own
        return arrays, metadata

    @classmethod
    def from_state(cls, arrays: Arrays, metadata: Metadata, settings: Settings, name: str = "") -> Compressor:
        """Restore a compressor from its `state`; KeyError, TypeError or ValueError if the state is invalid."""
        self = cls(settings, name)
        self.began, self.frame = int(metadata["began"]), int(metadata["frame"])
        self.box = Box(*metadata["box"]) if metadata["box"] else None
        if "detector" in metadata:
            self.detector = unpack(DetectorState, arrays, metadata["detector"], "detector")
        if "sample" in metadata:
            self.last_sample = unpack(Sample, arrays, metadata["sample"], "sample")
        self._sampled_leaves = int(metadata["sampled_leaves"])
        self.centres, self._path = arrays["centres"], [(x, y) for x, y in arrays["path"].tolist()]
        self._origin, self._earlier = str(metadata["origin"]), tuple(map(str, metadata["earlier"]))
        self.trees |= unpack_trees(arrays, metadata["trees"])
        return self


def sample_of(
    trees: Mapping[str, CoresetTree],
    version: int,
    frame: int,
    centres: np.ndarray,
    name: str,
    began: int = 0,
) -> Sample:
    """The sample of all trees of an object that have a leaf."""
    summaries = {kind: tree.sample() for kind, tree in trees.items() if tree.nodes}
    return Sample(version, frame, summaries, centres, name, began)


def _rows_of(tree: Tree, training: TrainingRows) -> Float32:
    """The rows of a tree, times the roots of their weights: rows with its label, or all rows with their labels."""
    rows: Float32 = training.rows
    if tree.label is not None:
        has_label: Bool = training.labels == tree.label
        return rows[has_label]
    d = rows.shape[1]
    roots = np.sqrt(training.weights, dtype=np.float32)[:, None]
    wide = np.empty((len(rows), d + tree.more_columns), np.float32)
    np.multiply(rows, roots, out=wide[:, :d])
    wide[:, d] = 1
    wide[:, d + 1] = training.labels
    wide[:, d + 2 :] = _NO_OFFSET if training.offsets is None else training.offsets
    wide[:, d:] *= roots
    return wide

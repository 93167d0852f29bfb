"""The compressor: takes the features of every frame, and returns a training sample now and then.

It is the only owner of the coreset trees: one for each head of `catstream.heads`.
"""

from __future__ import annotations

import os

import numpy as np

from catstream import storage
from catstream.arrays import Bool, Float32
from catstream.box import Box
from catstream.compression.tree import TREES, CoresetTree
from catstream.errors import ProtocolError, ServiceError, SettingsError
from catstream.heads import HEADS, Head
from catstream.messages import DetectorState, Features, Position, Sample, TrainingRows
from catstream.packing import pack, unpack
from catstream.settings import Settings
from catstream.storage import Arrays, Metadata

__all__ = ["Compressor"]

_KIND = "compressor 3"  # and the version of what a checkpoint holds
_GROWTH = 9 / 8  # factor of leaves from one sample to the next, however few frames lie between


class Compressor:
    """Summarises all frames so far, and returns a sample when the trees have grown enough.

    Constant time a frame on average, logarithmic memory. The same messages make
    the same samples, bit for bit, also across `save` and `load`.

    Parameters
    ----------
    tree : class of its trees; None for that of the setting `coreset.reduction`

    Attributes
    ----------
    last_sample : the newest sample, None before the first
    detector : the detector state in the last message: a restarted detector continues from it
    """

    def __init__(self, settings: Settings, tree: type[CoresetTree] | None = None) -> None:
        if settings.coreset.share:
            raise SettingsError(
                f"coreset.share={settings.coreset.share:g} is a share of a video's length: "
                "call Settings.for_length first, or set coreset.size"
            )
        self.settings = settings
        self._tree = tree or TREES[settings.coreset.reduction]
        self.seq = 0
        self.frame = -1
        self.last_sample: Sample | None = None
        self._forget()

    def _forget(self) -> None:
        """Reset everything except the position in the stream and the version of the samples."""
        self.trees = {name: self._tree(self.settings.coreset.size) for name in HEADS}
        self.centres = np.empty((0, 2))
        self._path: list[tuple[float, float]] = []
        self.box: Box | None = None
        self.detector: DetectorState | None = None
        self._sampled_leaves = 0  # 0 before the first sample of an object

    @classmethod
    def from_sample(cls, sample: Sample, settings: Settings) -> Compressor:
        """A compressor whose trees are made from a sample of an earlier stream, one node each; versions continue."""
        self = cls(settings)
        for name, summary in sample.trees.items():
            self.trees[name] = self._tree.from_summary(summary, settings.coreset.size)
        self.last_sample, self.centres, self._sampled_leaves = sample, sample.centres, self.leaves
        return self

    def check_features(self, features: Features) -> None:
        """Raise ProtocolError if rows have another length than those before."""
        before = {self.trees[name].width - head.more_columns for name, head in HEADS.items() if self.trees[name].width}
        width = max(before, default=0)
        for training in features.training.values():
            if width and training.rows.shape[1] != width:
                raise ProtocolError(
                    f"features rows have length {training.rows.shape[1]}, those before {width}: "
                    "start all processes with the same catstream and the same settings",
                    "width",
                )

    def take(self, features: Features) -> Sample | None:
        """Insert the features of one frame; returns a sample if the trees have grown enough since the last one.

        If a new object begins, all trees begin anew; the versions of samples continue. A message whose `seq`
        was processed before is ignored.

        Raises
        ------
        ProtocolError
            If a message before this one is missing, or its rows have another length than those before. Nothing of it
            is inserted.
        """
        if features.seq <= self.seq:
            return None
        if features.seq != self.seq + 1:
            raise ProtocolError(
                f"features {features.seq} came after {self.seq}: {features.seq - self.seq - 1} are missing, "
                "send from the one after the last acknowledged"
            )
        if features.begins:
            self._forget()
        self.check_features(features)  # before the first tree takes its rows, so that all trees hold the same frames
        for name, head in HEADS.items():
            if (training := features.training.get(head.group)) is not None:
                self.trees[name].insert(_rows_of(head, training))
        self.seq, self.frame, self.detector = features.seq, features.frame, features.detector
        if features.box is not None:
            self.box = features.box
        self._follow(features.box)
        return self._sample() if self._due() else None

    @property
    def version(self) -> int:
        """Version of the last sample, 0 before the first."""
        return self.last_sample.version if self.last_sample else 0

    @property
    def position(self) -> Position:
        """Position at which the stream continues, once everything that was processed is stored."""
        return Position(self.seq, max(self.frame, 0), self.box, self.sampled, self.detector)

    @property
    def leaves(self) -> int:
        """Number of leaves that were inserted into the trees."""
        return sum(self._leaves().values())

    @property
    def sampled(self) -> int:
        """Version of the last sample, 0 if it was of another object."""
        return self.version if self._sampled_leaves else 0

    def counters(self) -> dict[str, float]:
        """Counters for the health messages."""
        return {
            "seq": self.seq,
            "version": self.version,
            "rows": sum(tree.rows_seen for tree in self.trees.values()),
            "leaves": self.leaves,
            **{f"{name}_leaves": leaves for name, leaves in self._leaves().items()},
            "level": max((node.level for tree in self.trees.values() for node in tree.nodes), default=0),
            "nodes": sum(len(tree.nodes) for tree in self.trees.values()),
            "bytes": sum(tree.nbytes for tree in self.trees.values()),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one file, atomically."""
        arrays, metadata = self.state()
        storage.write(path, arrays, metadata | {"kind": _KIND})

    def state(self) -> tuple[Arrays, Metadata]:
        """Arrays and metadata that `from_state` restores."""
        arrays: Arrays = {"centres": self.centres, "path": np.array(self._path).reshape(-1, 2)}
        metadata: Metadata = {
            "seq": self.seq,
            "frame": self.frame,
            "box": list(self.box) if self.box else None,
            "sampled_leaves": self._sampled_leaves,
            "trees": {},
        }
        # The trees grow after a sample was made. The sample is kept too, so that a restarted trainer trains the same
        # model again that the detector uses.
        for name, message in (("sample", self.last_sample), ("detector", self.detector)):
            if message is not None:
                own, metadata[name] = pack(message, name)
                arrays |= own
        for name, tree in self.trees.items():
            own, metadata["trees"][name] = tree.state()
            arrays |= {f"{name}.{key}": array for key, array in own.items()}
        return arrays, metadata

    @classmethod
    def load(cls, path: str | os.PathLike[str], settings: Settings) -> Compressor:
        """Restore what `save` wrote.

        Raises
        ------
        ProtocolError
            If the file is damaged.
        ServiceError
            If it is not a checkpoint, or one of another version of catstream.
        SettingsError
            If it was made with another coreset size.
        """
        arrays, metadata = storage.read(path)
        if (kind := metadata.get("kind")) != _KIND:
            raise ServiceError(
                f"{path} is of kind {kind!r}, this catstream reads {_KIND!r}: continue with the version that wrote it, "
                "or start a new run in another folder"
            )
        try:
            self = cls.from_state(arrays, metadata, settings)
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise ProtocolError(f"{path} is not a compressor's state ({error!r}): use an older copy") from None
        if others := {tree.reduction for tree in self.trees.values()} - {settings.coreset.reduction}:
            raise SettingsError(
                f"{path} holds trees of coreset.reduction={max(others)}, the settings say "
                f"{settings.coreset.reduction}: continue with the same settings"
            )
        if sizes := {tree.size for tree in self.trees.values()} - {settings.coreset.size}:
            raise SettingsError(
                f"{path} holds trees of size {max(sizes)}, the settings say {settings.coreset.size}: "
                "continue with the same settings"
            )
        return self

    @classmethod
    def from_state(cls, arrays: Arrays, metadata: Metadata, settings: Settings) -> Compressor:
        """Restore what `state` returned; KeyError, TypeError or ValueError if it is something else."""
        self = cls(settings)
        self.seq, self.frame = int(metadata["seq"]), int(metadata["frame"])
        self.box = Box(*metadata["box"]) if metadata["box"] else None
        if "detector" in metadata:
            self.detector = unpack(DetectorState, arrays, metadata["detector"], "detector")
        if "sample" in metadata:
            self.last_sample = unpack(Sample, arrays, metadata["sample"], "sample")
        self._sampled_leaves = int(metadata["sampled_leaves"])
        self.centres, self._path = arrays["centres"], [(x, y) for x, y in arrays["path"].tolist()]
        for name, tree_metadata in metadata["trees"].items():
            own = {key.removeprefix(f"{name}."): array for key, array in arrays.items() if key.startswith(f"{name}.")}
            self.trees[name] = CoresetTree.from_state(own, tree_metadata)
        return self

    def _leaves(self) -> dict[str, int]:
        """Number of leaves of each tree."""
        return {name: tree.leaves for name, tree in self.trees.items()}

    def _follow(self, box: Box | None) -> None:
        """Append the centre of a box. Samples have complete blocks only, so that motion is trained once a block."""
        self._path.append(box.centre if box else (np.nan, np.nan))
        if len(self._path) == self.settings.search.motion_frames:
            self.centres = np.array(self._path)
            self._path = []

    def _due(self) -> bool:
        """Whether there is a new leaf, and the trees have grown by an eighth or the interval is over."""
        if not all(self.trees[name].nodes for name, head in HEADS.items() if head.adds_to_score):
            return False
        leaves, last = self.leaves, self.last_sample
        waited = last is not None and self.frame - last.frame >= self.settings.coreset.sample_interval
        return leaves > self._sampled_leaves and (waited or leaves >= _GROWTH * self._sampled_leaves)

    def _sample(self) -> Sample:
        self._sampled_leaves = self.leaves
        summaries = {name: tree.sample() for name, tree in self.trees.items() if tree.nodes}
        self.last_sample = Sample(self.version + 1, self.frame, summaries, self.centres)
        return self.last_sample


def _rows_of(head: Head, training: TrainingRows) -> Float32:
    """The rows that the tree of a head takes."""
    rows: Float32 = training.rows
    if head.label is not None:
        of_label: Bool = training.labels == head.label
        return rows[of_label]
    wide = np.empty((len(rows), rows.shape[1] + 2), np.float32)
    wide[:, :-2], wide[:, -2], wide[:, -1] = rows, 1, training.labels
    roots: Float32 = np.sqrt(training.weights, dtype=np.float32)
    return wide * roots[:, None]

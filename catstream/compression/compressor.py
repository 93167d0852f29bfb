"""The compressor: every frame's features in, now and then a sample to learn from out.

It is the only owner of the coreset trees: one for each head of `catstream.heads`.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from catstream import storage
from catstream.box import Box
from catstream.compression.tree import CoresetTree
from catstream.errors import ProtocolError, ServiceError, SettingsError
from catstream.heads import HEADS, Head
from catstream.messages import DetectorState, Features, Position, Sample, TrainingRows
from catstream.packing import pack, unpack
from catstream.settings import Settings

__all__ = ["Compressor"]

_KIND = "compressor 2"  # and the version of what a checkpoint holds
_GROWTH = 9 / 8  # factor of leaves from one sample to the next, however few frames lie between


class Compressor:
    """Summarises all frames so far; answers with a sample when there is something new to learn.

    Constant time a frame on average, logarithmic memory. The same messages make
    the same samples, bit for bit, also across `save` and `load`.

    Parameters
    ----------
    tree : class of its trees: what `sample` of one shows is learned from

    Attributes
    ----------
    last_sample : the newest, None before the first
    detector : the state of the detector that came with the last message: a restarted detector goes on from there
    """

    def __init__(self, settings: Settings, tree: type[CoresetTree] = CoresetTree) -> None:
        if settings.coreset.share:
            raise SettingsError(
                f"coreset.share={settings.coreset.share:g} is a share of a video's length: "
                "call Settings.for_length first, or set coreset.size"
            )
        self.settings = settings
        self._tree = tree
        self.seq = 0
        self.frame = -1
        self.last_sample: Sample | None = None
        self._forget()

    def _forget(self) -> None:
        """All but the stream of messages and the versions of samples, which go on."""
        self.trees = {name: self._tree(self.settings.coreset.size) for name in HEADS}
        self.centres = np.empty((0, 2))
        self._path: list[tuple[float, float]] = []
        self.box: Box | None = None
        self.detector: DetectorState | None = None
        self._sampled_leaves = 0  # 0 before the first sample of an object

    @classmethod
    def of(cls, sample: Sample, settings: Settings) -> Compressor:
        """Go on with what a sample of an earlier stream summarises, in trees of one node each; versions go on."""
        self = cls(settings)
        for name, summary in sample.trees.items():
            self.trees[name] = CoresetTree.of(summary, settings.coreset.size)
        self.last_sample, self.centres, self._sampled_leaves = sample, sample.centres, self.leaves
        return self

    def check(self, features: Features) -> None:
        """Raise ProtocolError where rows have another length than those before: they are of another stream."""
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
        """Store one frame's features; a sample where the trees have grown enough since the last.

        Where another object begins, all trees begin anew; versions of samples go on. A message
        that is stored already (by `seq`) is ignored.

        Raises
        ------
        ProtocolError
            Where a message is missing before this one, or its rows are of
            another length than those before. Nothing of it is stored.
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
        self.check(features)  # before the first tree takes its rows, so that all trees hold the same frames
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
        """That of the last sample, 0 before the first."""
        return self.last_sample.version if self.last_sample else 0

    @property
    def position(self) -> Position:
        """Where the stream of messages goes on, once all that was taken is stored."""
        return Position(self.seq, max(self.frame, 0), self.box, self.sampled, self.detector)

    @property
    def leaves(self) -> int:
        """Leaves ever inserted into the trees."""
        return sum(self._leaves().values())

    @property
    def sampled(self) -> int:
        """Version of the last sample, 0 where it was of another object."""
        return self.version if self._sampled_leaves else 0

    def counters(self) -> dict[str, float]:
        """What health tells of it."""
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
        """Write everything to one file, whole or not at all."""
        arrays, facts = self.state()
        storage.write(path, arrays, facts | {"kind": _KIND})

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays and facts that `from_state` goes on from."""
        arrays: dict[str, np.ndarray] = {"centres": self.centres, "path": np.array(self._path).reshape(-1, 2)}
        facts: dict[str, Any] = {
            "seq": self.seq,
            "frame": self.frame,
            "box": list(self.box) if self.box else None,
            "sampled_leaves": self._sampled_leaves,
            "trees": {},
        }
        # The trees grow on after a sample. The sample itself is kept too: from it, a trainer that starts anew learns
        # the model that the detector goes by.
        for name, message in (("sample", self.last_sample), ("detector", self.detector)):
            if message is not None:
                own, facts[name] = pack(message, name)
                arrays |= own
        for name, tree in self.trees.items():
            own, facts["trees"][name] = tree.state()
            arrays |= {f"{name}.{key}": array for key, array in own.items()}
        return arrays, facts

    @classmethod
    def load(cls, path: str | os.PathLike[str], settings: Settings) -> Compressor:
        """Go on where `save` was called.

        Raises
        ------
        ProtocolError
            If the file is damaged.
        ServiceError
            If it is not a checkpoint, or one of another version of catstream.
        SettingsError
            If it was made with another coreset size.
        """
        arrays, facts = storage.read(path)
        if (kind := facts.get("kind")) != _KIND:
            raise ServiceError(
                f"{path} is of kind {kind!r}, this catstream reads {_KIND!r}: go on with the catstream that wrote it, "
                "or begin anew in another folder"
            )
        try:
            self = cls.from_state(arrays, facts, settings)
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise ProtocolError(f"{path} is not a compressor's state ({error!r}): use an older copy") from None
        if sizes := {tree.size for tree in self.trees.values()} - {settings.coreset.size}:
            raise SettingsError(
                f"{path} holds trees of size {max(sizes)}, the settings say {settings.coreset.size}: "
                "go on with the same settings"
            )
        return self

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], facts: dict[str, Any], settings: Settings) -> Compressor:
        """Go on where `state` was called; KeyError, TypeError or ValueError if these are none."""
        self = cls(settings)
        self.seq, self.frame = int(facts["seq"]), int(facts["frame"])
        self.box = Box(*facts["box"]) if facts["box"] else None
        if "detector" in facts:
            self.detector = unpack(DetectorState, arrays, facts["detector"], "detector")
        if "sample" in facts:
            self.last_sample = unpack(Sample, arrays, facts["sample"], "sample")
        self._sampled_leaves = int(facts["sampled_leaves"])
        self.centres, self._path = arrays["centres"], [(x, y) for x, y in arrays["path"].tolist()]
        for name, tree_facts in facts["trees"].items():
            own = {key.removeprefix(f"{name}."): array for key, array in arrays.items() if key.startswith(f"{name}.")}
            self.trees[name] = CoresetTree.from_state(own, tree_facts)
        return self

    def _leaves(self) -> dict[str, int]:
        """Of each tree: the levels of its nodes are the ones in this number's binary digits."""
        return {name: sum(1 << node.level for node in tree.nodes) for name, tree in self.trees.items()}

    def _follow(self, box: Box | None) -> None:
        """Centres go out in whole blocks, so that the trainer learns the motion once a block."""
        self._path.append(box.centre if box else (np.nan, np.nan))
        if len(self._path) == self.settings.search.motion_frames:
            self.centres = np.array(self._path)
            self._path = []

    def _due(self) -> bool:
        """Trees that can teach, and a leaf more than last time: at once while they are small, else not too soon."""
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


def _rows_of(head: Head, training: TrainingRows) -> np.ndarray:
    """The rows that the tree of a head takes."""
    rows = training.rows
    if head.label is not None:
        return rows[training.labels == head.label]
    wide = np.empty((len(rows), rows.shape[1] + 2), np.float32)
    wide[:, :-2], wide[:, -2], wide[:, -1] = rows, 1, training.labels
    return wide * np.sqrt(training.weights, dtype=np.float32)[:, None]

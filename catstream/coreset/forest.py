"""The forest: a compressor for each object of a stream, and the checkpoint of all."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from catstream.base.settings import Settings
from catstream.coreset.compressor import Compressor
from catstream.errors import ProtocolError, ServiceError, SettingsError
from catstream.wire import storage
from catstream.wire.messages import DetectorState, Features, Sample
from catstream.wire.storage import Arrays, Metadata, with_prefix

_KIND = "forest 4"  # kind of file, and the version of its contents
_MAX_STATES = 256  # number of messages with stored detector states, from which a restarted detector continues


class Forest:
    """Inserts the features of every frame, and returns the samples of the objects whose trees have grown enough.

    An object begins with its first features, with new trees or the trees of an earlier stream. If a message lacks an
    object, its trees are dropped. The same messages make the same samples, bit for bit, also across `save` and `load`.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.seq = 0  #: number of the newest message
        self.frame, self.time = -1, 0.0  #: of the newest message, in seconds
        self.version = 0  #: of the newest sample; all objects share one count, so that no version is used twice
        self.compressors: dict[str, Compressor] = {}  #: by object
        self._states: deque[tuple[int, dict[str, DetectorState]]] = deque(maxlen=_MAX_STATES)  # of the last messages

    def check_features(self, features: Features) -> None:
        """Raise ProtocolError if rows differ in length from earlier ones."""
        width = max((compressor.width for compressor in self.compressors.values()), default=0)
        for part in features.objects.values():
            for training in part.training.values():
                if width and training.rows.shape[1] != width:
                    raise ProtocolError(
                        f"features rows have length {training.rows.shape[1]}, earlier rows {width}: "
                        "start all processes with the same catstream and the same settings",
                        "width",
                    )

    def take(
        self,
        features: Features,
        continued: Mapping[str, Compressor] = MappingProxyType({}),
        after_object: Callable[[], object] = lambda: None,
    ) -> list[Sample]:
        """Insert the features of one frame, calling `after_object` after each object; returns the new
        samples.

        A message with an earlier `seq` is ignored. `continued` has the compressors of the objects that begin with a
        saved model. ProtocolError if an earlier message is missing. Call `check_features` first for features from
        another process.
        """
        if features.seq <= self.seq:
            return []
        if features.seq != self.seq + 1:
            raise ProtocolError(
                f"features {features.seq} follow {self.seq}, {features.seq - self.seq - 1} are missing: "
                "retransmit all after the last acknowledged one"
            )
        # Step 1: drop the objects that the message lacks, and add new ones.
        compressors: dict[str, Compressor] = {}
        for name, part in features.objects.items():
            compressor = continued.get(name) if part.begins else self.compressors.get(name)
            compressors[name] = compressor or Compressor(self.settings, name)
        self.compressors = compressors
        # Step 2: insert the rows of each object.
        samples: list[Sample] = []
        for name, part in features.objects.items():
            compressor = compressors[name]
            if part.begins:
                self._add(compressor.begin(features.frame, self.version + 1), samples)
            self._add(compressor.take(features.frame, part, self.version + 1), samples)
            after_object()
        self.seq, self.frame, self.time = features.seq, features.frame, float(features.time)
        states = {name: part.detector for name, part in features.objects.items() if part.detector is not None}
        self._states.append((self.seq, states))
        return samples

    def skip_to(self, seq: int) -> None:
        """Continue after message `seq`. Earlier messages are lost, of a live source after a power failure."""
        if seq > self.seq:
            self.seq, self.frame = seq, seq - 1

    def states_at(self, seq: int | None) -> dict[str, DetectorState]:
        """The detector states of the objects, by name, after message `seq`, or after the nearest stored one.

        `seq` None is the newest message.
        """
        if not self._states:
            return {}
        earlier = [states for number, states in self._states if seq is None or number <= seq]
        return earlier[-1] if earlier else self._states[0][1]

    def _add(self, sample: Sample | None, samples: list[Sample]) -> None:
        """Add a sample, if there is one, to the samples of a frame."""
        if sample is not None:
            self.version = sample.version
            samples.append(sample)

    @property
    def versions(self) -> dict[str, int]:
        """Version of the newest sample of each object that has one, by name."""
        return {name: compressor.version for name, compressor in self.compressors.items() if compressor.version}

    @property
    def last_samples(self) -> list[Sample]:
        """The newest sample of each object that has one."""
        samples = [compressor.last_sample for compressor in self.compressors.values()]
        return [sample for sample in samples if sample is not None]

    def counters(self) -> dict[str, float]:
        """Counters of all objects together, for the health messages."""
        own = list(self.object_counters().values())
        names = dict.fromkeys(name for counters in own for name in counters)
        highest = {name for name in names if name in ("version", "level")}
        total = {name: (max if name in highest else sum)(counters[name] for counters in own) for name in names}
        return {"frames": self.seq, "objects": len(own)} | total | {"version": self.version}

    def object_counters(self) -> dict[str, dict[str, float]]:
        """Counters of each object, by name, for the health messages."""
        return {name: compressor.counters() for name, compressor in self.compressors.items()}

    def save(self, path: str | os.PathLike[str], *, durable: bool = True) -> None:
        """Write everything to one file, as `storage.write` does."""
        arrays: Arrays = {"states": np.frombuffer(_ENCODER.encode(list(self._states)), np.uint8)}
        objects: list[Metadata] = []
        for i, (name, compressor) in enumerate(self.compressors.items()):
            own, metadata = compressor.state()
            arrays |= {f"{i}.{key}": array for key, array in own.items()}
            objects.append(metadata | {"name": name})
        whole = {"seq": self.seq, "frame": self.frame, "time": self.time, "version": self.version}
        storage.write(path, arrays, whole | {"objects": objects, "kind": _KIND}, durable=durable)

    @staticmethod
    def position_in(path: str | os.PathLike[str]) -> tuple[int, float]:
        """Number of the newest message in a file that `save` wrote, and time of its frame; errors as from `load`."""
        metadata = storage.read_metadata(path)
        _check_kind(path, metadata)
        try:
            return int(metadata["seq"]), float(metadata["time"])
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"{path} is not a compressor's state ({error!r}): use an older copy") from None

    @classmethod
    def load(cls, path: str | os.PathLike[str], settings: Settings) -> Forest:
        """Load a forest from a file of `save`.

        ProtocolError if the file is damaged; ServiceError if it is not a checkpoint of this version of catstream;
        SettingsError if it has another coreset size.
        """
        arrays, metadata = storage.read(path)
        _check_kind(path, metadata)
        self = cls(settings)
        try:
            self.seq, self.frame, self.version = (int(metadata[name]) for name in ("seq", "frame", "version"))
            self.time = float(metadata["time"])
            for i, own in enumerate(metadata["objects"]):
                name = str(own["name"])
                self.compressors[name] = Compressor.from_state(with_prefix(arrays, f"{i}."), own, settings, name)
            self._states.extend(_DECODER.decode(arrays["states"].tobytes()))
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError, msgspec.DecodeError) as error:
            raise ProtocolError(f"{path} is not a compressor's state ({error!r}): use an older copy") from None
        trees = [tree for compressor in self.compressors.values() for tree in compressor.trees.values()]
        if sizes := {tree.size for tree in trees} - {settings.coreset.size}:
            raise SettingsError(
                f"{path} has trees of size {max(sizes)}, the settings say {settings.coreset.size}: "
                "continue with the same settings"
            )
        return self


def _array(_: type, numbers: Any) -> Any:
    """Decode an array of a state, which is encoded as lists of numbers."""
    return np.array(numbers)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=lambda array: array.tolist())
_DECODER = msgspec.msgpack.Decoder(list[tuple[int, dict[str, DetectorState]]], dec_hook=_array)


def _check_kind(path: str | os.PathLike[str], metadata: Metadata) -> None:
    """Raise ServiceError unless a file is a checkpoint of this version."""
    if (kind := metadata.get("kind")) != _KIND:
        raise ServiceError(
            f"{path} is of kind {kind!r}, this catstream reads {_KIND!r}: continue with the version that wrote it, "
            "or start a new run in another folder"
        )

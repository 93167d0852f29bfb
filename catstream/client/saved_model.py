"""A saved model: everything learned about one object, in one file.

The file contains the complete coreset trees, with their dropped energy, and the model that was trained from them. A
run in another video continues the training, as if the frames of both came from one stream.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Self

import numpy as np

from catstream.base.box import Box
from catstream.base.files import write_atomically, writing
from catstream.base.names import check_name
from catstream.base.settings import Settings
from catstream.base.text import listed
from catstream.base.threads import one_thread
from catstream.coreset.compressor import Compressor, sample_of
from catstream.coreset.reduce import energy
from catstream.coreset.tree import CoresetTree, pack_trees, unpack_trees
from catstream.detection.similarity import Similarity
from catstream.errors import MissingFileError, ProtocolError, ServiceError, SettingsError
from catstream.features.layout import ROW_LENGTH
from catstream.wire import storage
from catstream.wire.heads import TREES
from catstream.wire.messages import LARGEST_INITIAL_MODEL, LARGEST_INITIAL_MODELS, Features, Model
from catstream.wire.schema import check_message
from catstream.wire.storage import Metadata, pack, unpack

_KIND = "saved model 5"  # kind of file, and the version of its contents

#: Settings that determine the content of rows and trees: models with different ones cannot be merged or continued.
_SAME = ("coreset.size", "training.colours", "training.classifier")

#: Similarity of two models below which a merge is rejected, and below which it causes a warning: see decision 54.
_UNLIKE, _DOUBTFUL = 0.25, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class SavedModel:
    """Everything learned about an object. The trees are never changed: `compressor` copies them.

    object    name of the object, empty for the object without a name
    trees     coreset tree of each head of `catstream.wire.heads`
    centres   centres of the object in the last complete block of frames, as in a `Sample`
    origins   digest of the first training rows of each stream that the trees contain
    box       last box of the object in pixels; only its size matters in another video
    model     trained from the trees; its frame is 0
    settings  of the run that trained the model
    """

    object: str
    trees: dict[str, CoresetTree]
    centres: np.ndarray
    origins: tuple[str, ...]
    box: Box
    model: Model
    settings: Settings

    @classmethod
    def of(cls, compressor: Compressor, settings: Settings) -> Self:
        """Make a saved model from the state of a compressor, and train its model.

        ServiceError if the trees have no leaf yet, or the object was not found yet.
        """
        state = compressor.detector
        if state is not None and state.is_searched:
            raise ServiceError("the object of the saved model was not found yet, so there is nothing new to save")
        if compressor.box is None or state is None or not compressor.version:
            raise ServiceError("nothing was learned of the object yet, so there is nothing to save")
        trees = {label: tree.copy() for label, tree in compressor.trees.items()}
        centres, name = compressor.centres, compressor.name
        model = _trained(trees, centres, compressor.version, name, settings)
        return cls(name, trees, centres, compressor.origins, compressor.box, model, settings)

    def compressor(self, settings: Settings, name: str = "") -> Compressor:
        """Continue copies of the trees with another stream, in which the object has this name; versions continue.

        SettingsError as in `check_fits`.
        """
        self.check_fits(settings)
        version = self.model.version
        return Compressor.continuing(self.trees, version, self.centres, self.origins, settings, name)

    def check_fits(self, settings: Settings) -> None:
        """Raise SettingsError if a run with these settings cannot continue the trees."""
        _check_same(self.settings, settings, "the saved model was learned", "this run has")

    @one_thread()
    def similarity(self) -> Similarity:
        """The measure of the similarity of a window to the object: see `catstream.detection.similarity`."""
        tree, background = self.trees["object"], self.trees["background"]
        rows = tree.rows
        total_energy = energy(rows) + tree.dropped_energy
        mean = (background.sum / background.rows_seen).astype(np.float32)
        return Similarity.of(rows, total_energy, tree.sum, tree.rows_seen, mean)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one safetensors file, atomically; ServiceError if it cannot be written."""
        with writing(path):
            write_atomically(path, self.to_bytes())

    def to_bytes(self) -> bytes:
        """The content of the file that `save` writes."""
        arrays, trees = pack_trees(self.trees)
        model_arrays, model = pack(self.model, "model")
        metadata: Metadata = {
            "kind": _KIND,
            "object": self.object,
            "trees": trees,
            "origins": list(self.origins),
            "box": list(self.box),
            "model": model,
            "settings": {name: value for name, value in self.settings.values().items() if not name.startswith("run.")},
        }
        return storage.encode(arrays | model_arrays | {"centres": self.centres}, metadata)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read the file that `save` wrote.

        ServiceError if it does not exist, or cannot be read; ProtocolError if it is damaged, is not a saved model, or
        has other features.
        """
        try:
            data = Path(path).read_bytes()
        except FileNotFoundError:
            raise MissingFileError(f"there is no saved model {str(path)!r}: `catstream save` writes one") from None
        except OSError as error:
            raise ServiceError(f"cannot read {str(path)!r} ({error.strerror}): pass a saved model") from None
        return cls.from_bytes(data, str(path))

    @classmethod
    def from_bytes(cls, data: bytes, name: str) -> Self:
        """The inverse of `to_bytes`, with the errors of `load`, which contain `name`."""
        arrays, metadata = storage.decode(data, name)
        try:
            if metadata.get("kind") != _KIND:
                raise ValueError(f"it is of kind {metadata.get('kind')!r}, not {_KIND!r}")
            trees = unpack_trees(arrays, metadata["trees"])
            if missing := [name for name in TREES if name not in trees]:
                raise ValueError(f"it has no tree {missing[0]!r}: track the object again with this version")
            saved = cls(
                check_name(metadata["object"]),
                {name: trees[name] for name in TREES},
                arrays["centres"],
                tuple(map(str, metadata["origins"])),
                Box(*map(float, metadata["box"])),
                unpack(Model, arrays, metadata["model"], "model"),
                Settings.from_values(metadata["settings"]),
            )
            saved._check()
        except (AttributeError, LookupError, OverflowError, TypeError, ValueError) as error:
            raise ProtocolError(f"{name} is not a saved model ({error}): `catstream save` writes one") from None
        width = len(saved.model.weights)
        if width != ROW_LENGTH:
            raise ProtocolError(
                f"{name} has {width} features of a window, this catstream has {ROW_LENGTH}: "
                "track the object again with this version"
            )
        return saved

    def _check(self) -> None:
        """Raise ValueError if the parts are inconsistent."""
        check_message(self.model)
        check_message(sample_of(self.trees, self.model.version, 0, self.centres, self.object))
        x, y, w, h = self.box
        if not (np.isfinite((x, y)).all() and 0 < w < np.inf and 0 < h < np.inf):
            raise ValueError(f"its box is {self.box}")
        for name, kind in TREES.items():
            tree, width = self.trees[name], len(self.model.weights) + kind.more_columns
            if tree.size != self.settings.coreset.size or tree.width not in (0, width):
                raise ValueError(f"its tree {name!r} has {tree.size} rows of length {tree.width}")


def check_files(files: Mapping[str, Path], settings: Settings) -> None:
    """Check that objects, by name, can begin with the saved models in these files in the first frame.

    ServiceError or ProtocolError if one cannot be read; SettingsError if one has other settings, or they are too large.
    """
    for file in files.values():
        SavedModel.load(file).check_fits(settings)
    check_sizes({name: file.stat().st_size for name, file in files.items()})


def check_sizes(sizes: Mapping[str, int]) -> None:
    """Raise SettingsError if the saved models of objects, by name, are too large to begin in one frame."""
    advice = "track fewer at once, or train them again with a smaller coreset.size"
    for name, size in sizes.items():
        if size > LARGEST_INITIAL_MODEL:
            raise SettingsError(
                f"the saved model of {listed([name])} is too large ({size >> 20} MiB, limit "
                f"{LARGEST_INITIAL_MODEL >> 20}): {advice}"
            )
    if (total := sum(sizes.values())) > LARGEST_INITIAL_MODELS:
        raise SettingsError(
            f"the saved models of {listed(sizes)} are too large for one frame ({total >> 20} MiB together, limit "
            f"{LARGEST_INITIAL_MODELS >> 20}): {advice}"
        )


def continued(features: Features, settings: Settings) -> dict[str, Compressor]:
    """The compressors, by name, of the objects that begin with a saved model in a message.

    ProtocolError if a saved model is damaged or has other features; SettingsError if it has other settings.
    """
    models = {name: part.model for name, part in features.objects.items() if part.model}
    return {
        name: SavedModel.from_bytes(model, f"the saved model of {listed([name])}").compressor(settings, name)
        for name, model in models.items()
    }


@one_thread()  # more threads would add in another order, and change the bits
def merge(parts: Iterable[SavedModel], *, force: bool = False) -> SavedModel:
    """Merge saved models of one object, as if one stream had contained all their frames.

    The trees are merged, and a model is trained from them. The bound of the merged tree is the sum of the bounds plus
    the energy that the merge itself loses; both are in its `dropped_energy`. The order of the parts does not matter
    for the numbers of rows; the rows themselves may differ within the bound.

    The size is the geometric mean of the sizes. An object without a name may be merged with one that has a name.

    The objects must look alike: each model is compared with the others by the similarity of its mean appearance (see
    `catstream.detection.similarity`), which counts in its better direction. Models of one object have 0.34 or more,
    most pairs of different objects less than 0.25. Below 0.5 there is a UserWarning. Several models may be a chain, for
    example of views from different sides: each needs to look like one of the others only.

    Parameters
    ----------
    force : merge without comparing the objects

    Raises
    ------
    SettingsError
        If there are fewer than two, if their settings or names differ, if two contain the same frames, or if their
        objects do not look alike (below 0.25); or if a part is not a `SavedModel`, for example a path.
    """
    # Step 1: reject parts that are not models of one object with the same settings, from different frames.
    parts = list(parts)
    if wrong := [part for part in parts if not isinstance(part, SavedModel)]:
        raise SettingsError(f"a merge takes saved models, got {wrong[0]!r}: read a file with catstream.SavedModel.load")
    if len(parts) < 2:
        raise SettingsError(f"too few saved models ({len(parts)}): a merge needs two or more")
    first, streams = parts[0], [origin for part in parts for origin in set(part.origins)]
    name, *others = dict.fromkeys(part.object for part in parts if part.object) or [""]
    if others:
        raise SettingsError(
            f"the saved models are of different objects ({name!r}, {others[0]!r}): merge models of the same object"
        )
    for part in parts[1:]:
        _check_same(first.settings, part.settings, "one saved model was trained", "another")
    if len(set(streams)) < len(streams):
        raise SettingsError(
            "two of the models were trained on the same frames, which would count twice: "
            "merge models from different videos"
        )
    if not force:
        _check_alike(parts)
    # Step 2: merge the trees, and train a model from them.
    trees = {name: reduce(CoresetTree.merged, [part.trees[name] for part in parts]) for name in TREES}
    centres = next((part.centres for part in parts if len(part.centres)), first.centres)
    version = max(part.model.version for part in parts)
    width, height = np.exp(np.mean(np.log([part.box[2:] for part in parts]), axis=0))  # the geometric means
    return replace(
        first,
        object=name,
        trees=trees,
        centres=centres,
        origins=tuple(origin for part in parts for origin in part.origins),
        box=first.box.scaled(float(width) / first.box.w, float(height) / first.box.h),
        model=_trained(trees, centres, version, name, first.settings),
    )


def _check_alike(parts: Sequence[SavedModel]) -> None:
    """Raise SettingsError, or warn, if the models do not look like models of one object.

    The models are connected by their highest similarities, as in a maximum spanning tree; the lowest of these decides.
    """
    measures = [part.similarity() for part in parts]
    means = [(tree.sum / tree.rows_seen).astype(np.float32) for tree in (part.trees["object"] for part in parts)]
    lowest, connected, rest = (1.0, 0, 0), [0], set(range(1, len(parts)))
    while rest:
        link = max((max(measures[i](means[j]), measures[j](means[i])), i, j) for i in connected for j in rest)
        lowest = min(lowest, link)
        connected.append(link[2])
        rest.remove(link[2])
    similarity, one, other = lowest
    if similarity < _DOUBTFUL:
        one, other = sorted((one + 1, other + 1))
        text = f"saved models {one} and {other} look like different objects (similarity {similarity:.2f}"
        if similarity < _UNLIKE:
            raise SettingsError(
                f"{text}, minimum {_UNLIKE}): merge models of the same object, or pass --force (force=True in Python) "
                "if it is the same"
            )
        warnings.warn(
            f"{text}, usually above {_DOUBTFUL} for the same object): check that the object is the same",
            stacklevel=4,  # the caller of the decorated `merge`
        )


def _trained(trees: dict[str, CoresetTree], centres: np.ndarray, version: int, name: str, settings: Settings) -> Model:
    from catstream.training.trainer import Trainer

    with one_thread():  # as in a pipeline, for the same bits
        return Trainer(settings).train(sample_of(trees, version, 0, centres, name))


def _check_same(ours: Settings, theirs: Settings, one: str, other: str) -> None:
    """Raise SettingsError if one of the settings in `_SAME` differs."""
    own, others = ours.values(), theirs.values()
    for name in _SAME:
        if own[name] != others[name]:
            raise SettingsError(f"{one} with {name}={own[name]}, {other} {name}={others[name]}: use the same setting")

"""Merges what the streams of a fleet have learned of one object: a reduction of saved models in pairs, as Ray tasks.

Frames are counted once. A saved model contains the origins of its trees, one for each stream of frames; a model that
shares an origin with another one has learned from the same frames, so only one of them is merged. Merging again, or in
another order, therefore changes nothing. The order of the pairs changes the merged trees only within the bound of the
coreset: see `catstream.run.learned.merge`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from catstream.errors import CatstreamError, FleetError, ObjectError, ServiceError, StoreError
from catstream.fleet.store import Store
from catstream.run import state
from catstream.run.job import Job
from catstream.run.learned import Learned, merge

Model = TypeVar("Model")

#: The last merged model, among the names of the streams.
_EARLIER = "the last merge"


@dataclass(frozen=True, slots=True)
class Part:
    """The properties of a saved model that decide whether it is merged.

    origins  of its trees, one for each stream of frames that they contain
    rows     training rows that were inserted into its trees
    """

    origins: frozenset[str]
    rows: int

    @classmethod
    def of(cls, learned: Learned) -> Part:
        """The part of a saved model."""
        return cls(frozenset(learned.origins), sum(tree.rows_seen for tree in learned.trees.values()))


@dataclass(frozen=True, slots=True)
class Merged:
    """A merged model, which is in the store.

    model    the content of its file
    streams  that it was merged from; the last merged model may be among them
    skipped  streams whose frames are in one of those already, or that share frames with one of those
    """

    model: bytes
    streams: tuple[str, ...]
    skipped: tuple[str, ...]


def disjoint(parts: Mapping[str, Part]) -> list[str]:
    """Return the names of parts that share no origin, with as many origins as possible, and then as many rows.

    Two choices are compared: the parts with the most origins first, as a merged model has them, and those with the
    fewest first. So newer states of the streams take the place of an earlier merge, unless that has seen a stream more.

    Examples
    --------
    >>> door, yard, both = Part(frozenset("a"), 90), Part(frozenset("b"), 20), Part(frozenset("ab"), 70)
    >>> disjoint({"door": door, "yard": yard, "both": both})
    ['door', 'yard']
    >>> disjoint({"door": door, "both": both})
    ['both']
    """
    choices: list[list[str]] = []
    for sign in (-1, 1):  # first the parts with the most origins, then those with the fewest
        key = {name: (sign * len(part.origins), -part.rows, sorted(part.origins)) for name, part in parts.items()}
        chosen: list[str] = []
        for name in sorted(parts, key=key.__getitem__):
            if not any(parts[name].origins & parts[other].origins for other in chosen):
                chosen.append(name)
        choices.append(chosen)

    def size(names: list[str]) -> tuple[int, int]:
        return sum(len(parts[name].origins) for name in names), sum(parts[name].rows for name in names)

    return max(choices, key=size)


def merge_in_pairs(models: Sequence[Model], join: Callable[[Model, Model], Model]) -> Model:
    """Merge models two by two until one is left, in as few rounds as possible.

    Examples
    --------
    >>> merge_in_pairs(["a", "b", "c", "d", "e"], lambda one, other: f"({one}{other})")
    '(((ab)(cd))e)'
    """
    while len(models) > 1:
        pairs = [join(one, other) for one, other in zip(models[::2], models[1::2], strict=False)]
        models = [*pairs, *models[len(models) - len(models) % 2 :]]
    return models[0]


def merge_streams(url: str, streams: Iterable[str], name: str, *, named: bool) -> Merged:
    """Merge the newest states of streams as tasks of the connected cluster, and store the model if it is a new one.

    Parameters
    ----------
    url : of the store
    streams : their names
    name : the object
    named : whether each stream has to know the object. Otherwise the streams that do not are left out, and the last
        merged model is merged too, because its streams may have been removed

    Raises
    ------
    FleetError
        If a stream does not know the object, or none does, or neither the object nor the streams are named.
    SettingsError
        If the settings of two streams differ.
    StoreError
        If the store cannot be reached.
    """
    if not name and not named:
        raise FleetError(
            "objects without a name may be different ones: name the object (--object NAME), or the streams that show it"
        )
    import ray
    from ray.exceptions import RayTaskError

    remote: Any = ray.remote
    # Ray reserves a core of one node for a task by default, and waits for it without end if the streams have them all.
    load, join = remote(num_returns=2, num_cpus=0)(saved_part), remote(num_cpus=0)(joined)
    refs: dict[str, Any] = {stream: load.remote(url, stream, name, named=named) for stream in streams}
    models = Store(url).model(name)
    earlier = before.files["model"] if (before := models.newest()) is not None else None
    if earlier is not None and not named:
        refs[_EARLIER] = ray.put(Part.of(Learned.from_bytes(earlier, _EARLIER))), ray.put(earlier)
    try:
        found = {stream: ray.get(part) for stream, (part, _) in refs.items()}
        parts = {stream: part for stream, part in found.items() if part is not None}
        if not parts:
            raise FleetError(f"no stream has learned of {name or 'the object'!r} yet: see catstream fleet status")
        chosen = disjoint(parts)
        merged: bytes = ray.get(merge_in_pairs([refs[stream][1] for stream in chosen], join.remote))
    except RayTaskError as error:
        raise (error.cause if isinstance(error.cause, CatstreamError) else error) from None
    if merged != earlier:  # the streams that follow the object get each new model
        models.put({"model": merged}, {"streams": chosen})
    return Merged(merged, tuple(chosen), tuple(stream for stream in parts if stream not in chosen))


def saved_part(url: str, stream: str, name: str, *, named: bool) -> tuple[Part, bytes] | tuple[None, None]:
    """Return what the newest state of a stream in the store has learned of an object; None twice if it has nothing.

    Raises
    ------
    FleetError
        If it has nothing, although the stream was `named`.
    """
    try:
        if (newest := Store(url).stream(stream).newest()) is None:
            raise FleetError("there is no state of it in the store yet")
        with tempfile.TemporaryDirectory(prefix="catstream-merge-") as folder:
            state.restore(Path(folder), newest.files)
            learned = state.learned(Path(folder), Job.load(Path(folder)).settings, name)
    except StoreError:
        raise
    except (ObjectError, ServiceError) as error:
        if named:
            raise FleetError(f"stream {stream}: {error}") from None
        return None, None
    return Part.of(learned), learned.to_bytes()


def joined(one: bytes, other: bytes) -> bytes:
    """Two saved models merged. The name says that the object is the same, so its appearances are not compared."""
    parts = [Learned.from_bytes(model, "the saved model of a stream") for model in (one, other)]
    return merge(parts, force=True).to_bytes()

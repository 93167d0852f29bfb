"""The desired state of a fleet: its streams, as a file in TOML describes them.

    name = "site"                      # the default is the name of the file
    store = "state"                    # a folder, file:///..., or s3://bucket/prefix
    every = 5.0                        # seconds between two states of a stream in the store
    nodes = 3                          # nodes that are started if the fleet runs on this machine alone
    registry = "10.0.0.1:5690"         # where clients ask for the streams of a cluster; the default is its head
    keys = "keys"                      # folder of the clients' keys on that machine

    [streams.cam-7]
    source = "rtsp://camera/1"
    box = [120, 80, 64, 48]            # or boxes = { anna = [...] }, model = "a.safetensors", models = { anna = "..." }
    settings = { "coreset.size" = 128 }
    cores = 0.5                        # that Ray reserves for it; the default is 1
    labels = { site = "north" }        # labels that its node must have
    follow = ["anna"]                  # objects whose merged model this stream searches for

Relative paths count from the folder of the file. Every error is a `FleetError` that names the stream.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import re
import reprlib
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from catstream.box import Box
from catstream.errors import CatstreamError, FleetError
from catstream.messages.names import UNNAMED, boxes_by_name, check_name, listed
from catstream.run.job import Job
from catstream.settings import Settings
from catstream.video.source import is_live

__all__ = ["FleetSpec", "StreamSpec"]

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_REGISTRY = re.compile(r"[A-Za-z0-9_.-]+:[0-9]{1,5}")
_STREAM_HEADER = re.compile(r"\s*\[\s*streams\s*\.\s*[\"']?([\w.-]+)")
_MOST_NODES = 64  # on one machine
_FLEET_KEYS = ("name", "store", "every", "nodes", "registry", "keys")
_EVERY = 5.0
_LONGEST_EVERY = 3600.0

#: Settings that the fleet sets for each stream.
_OWN_SETTINGS = ("run.endpoint", "run.keys")


@dataclass(frozen=True, slots=True)
class StreamSpec:
    """A stream that a fleet should run.

    name      unique in the fleet: 1 to 64 letters, digits, '_', '-' and '.', not '-' or '.' first
    source    the text that `catstream track` takes
    boxes     the objects in the first frame, by name
    models    file of each object that is searched for, by name
    settings  values of settings by full name
    cores     cores that Ray reserves for it
    labels    labels that its node must have
    follow    objects whose merged model it searches for

    Raises
    ------
    FleetError
        If a value is not valid.

    Examples
    --------
    >>> cam = StreamSpec("cam-7", "rtsp://camera/1", boxes={"": Box(120, 80, 64, 48)})
    >>> cam.digest == StreamSpec("cam-7", "rtsp://camera/1", boxes={"": Box(120, 80, 64, 48)}, cores=2.0).digest
    True
    """

    name: str
    source: str = field(repr=False)  # it may contain a password
    boxes: dict[str, Box] = field(default_factory=dict)
    models: dict[str, Path] = field(default_factory=dict)
    settings: dict[str, object] = field(default_factory=dict)
    cores: float = 1.0
    labels: dict[str, str] = field(default_factory=dict)
    follow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_fleet_name(self.name, "stream")
        with _errors_about(self.name):
            if not isinstance(self.source, str) or not self.source.strip():
                raise FleetError(
                    "it has no source: give a text as `catstream track` takes it, for example "
                    'source = "rtsp://camera/1"'
                )
            for name, box in self.boxes.items():
                with _errors_in(f"the box of {listed([name])}"):
                    box.checked()
            for name in _OWN_SETTINGS:
                if name in self.settings:
                    raise FleetError(f"the fleet sets {name} itself: remove it from the settings")
            Job(self.source, self.boxes, self.models, settings=Settings.from_values(self.settings))
            if not (math.isfinite(self.cores) and self.cores > 0):
                raise FleetError(
                    f"cores must be a number above 0, got {self.cores:g}: catstream fleet status shows what it uses"
                )

    @classmethod
    def parse(cls, name: str, table: Mapping[str, object], folder: Path) -> StreamSpec:
        """Make a stream from the table of a file in `folder`; the docstring of the module shows one."""
        _check_fleet_name(name, "stream")
        with _errors_about(name):
            if not isinstance(table, Mapping):
                raise FleetError(f"expected a table with a source, got {reprlib.repr(table)}: write [streams.{name}]")
            _check_keys(table, _READERS)
            for one, several in (("box", "boxes"), ("model", "models")):
                if one in table and several in table:
                    raise FleetError(f"it has both {one} and {several}: write all objects in {several}")
            fields: dict[str, Any] = {"source": ""}
            for key, value in table.items():
                target, read = _READERS[key]
                fields[target] = read(key, value, folder)
        return cls(name, **fields)

    @property
    def digest(self) -> str:
        """Text that changes exactly if the stream has to start again: with its source, objects or settings.

        A change of `cores`, `labels` or `follow` does not change it: the stream then continues from its state, on a
        node with the labels, and learns of other objects to search for while it runs. Settings count by their values,
        so that writing down a default changes nothing. Of a model, its path counts and not its content.
        """
        models = {name: str(file) for name, file in self.models.items()}
        boxes = {name: list(map(float, box)) for name, box in self.boxes.items()}
        parts = [self.source, boxes, models, Settings.from_values(self.settings).changed()]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]

    def table(self) -> dict[str, object]:
        """The stream as the table of a file, with every path as it is; `parse` reads it."""
        table: dict[str, object] = {"source": self.source, "settings": self.settings, "labels": self.labels}
        table |= {"boxes": {name: list(box) for name, box in self.boxes.items()}, "follow": list(self.follow)}
        table |= {"models": {name: str(file) for name, file in self.models.items()}, "cores": self.cores}
        return {key: value for key, value in table.items() if value not in ({}, [], None)}


@dataclass(frozen=True, slots=True)
class FleetSpec:
    """The desired state of a fleet.

    name     name of the fleet, with the rules of a stream's name
    store    folder or URL of the states; "" for a folder that belongs to the fleet
    every    seconds between two states of a stream in the store
    nodes    how many nodes are started for a fleet on one machine alone
    registry HOST:PORT where clients ask for the streams; "" for the head of the cluster, and the default port
    keys     folder of the clients' keys on that machine; "" for the one of the fleet's name
    streams  the streams by name
    """

    name: str
    store: str = ""
    every: float = _EVERY
    nodes: int = 1
    registry: str = ""
    keys: str = ""
    streams: dict[str, StreamSpec] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_fleet_name(self.name, "fleet")
        if not 0 < self.every <= _LONGEST_EVERY:
            raise FleetError(f"the fleet {self.name}: every must be above 0 and at most 3600 s, got {self.every:g}")
        if self.registry and not _REGISTRY.fullmatch(self.registry):
            raise FleetError(
                f"the fleet {self.name}: registry must be HOST:PORT of a node, as in 10.0.0.1:5690, got "
                f"{self.registry!r}"
            )
        if not 1 <= self.nodes <= _MOST_NODES:
            raise FleetError(f"the fleet {self.name}: nodes must be from 1 to {_MOST_NODES}, got {self.nodes}")

    @classmethod
    def load(cls, path: Path) -> FleetSpec:
        """Read the file of a fleet.

        Raises
        ------
        FleetError
            If it cannot be read, has no streams, or has a key or value that is not valid.
        """
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise FleetError(f"cannot read the fleet file {path}: {error.strerror}") from None
        except ValueError:
            raise FleetError(f"the fleet file {path} is not UTF-8 text: save it as TOML") from None
        try:
            tables = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise FleetError(f"{path}: {_toml_problem(str(error), text)}") from None
        with _errors_in(str(path)):
            if not tables.get("streams"):
                raise FleetError(
                    'it has no streams: add a table for each, for example [streams.cam-1] with source = "demo:1"'
                )
            return cls._of({"name": path.stem} | tables, path.parent.absolute())

    def to_json(self) -> str:
        """The spec as JSON text with absolute paths. It contains the sources with their passwords."""
        streams = {name: stream.table() for name, stream in self.streams.items()}
        own = {name: getattr(self, name) for name in _FLEET_KEYS}
        return json.dumps(own | {"streams": streams})

    def changes(self, new: FleetSpec) -> list[str]:
        """Describe the change of each stream if another spec takes the place of this one, a line for each."""
        lines = []
        for name in sorted(self.streams.keys() | new.streams.keys()):
            before, after = self.streams.get(name), new.streams.get(name)
            if before is None or after is None:
                lines.append(f"{name}: is {'added' if before is None else 'removed'}")
            elif before.digest != after.digest:
                lines.append(f"{name}: starts again with its changes")
            else:
                lines.append(f"{name}: {'is unchanged' if before == after else 'continues with its changes'}")
        return lines

    @classmethod
    def from_json(cls, text: str) -> FleetSpec:
        """Read the text that `to_json` wrote; raise FleetError if it is damaged."""
        try:
            tables = json.loads(text)
        except (ValueError, RecursionError):
            tables = None
        if not isinstance(tables, dict) or "name" not in tables:
            raise FleetError("the stored spec of the fleet is damaged: apply the fleet file again")
        return cls._of(tables, Path("/"))

    @classmethod
    def _of(cls, tables: Mapping[str, Any], folder: Path) -> FleetSpec:
        _check_keys(tables, (*_FLEET_KEYS, "streams"))
        store, streams = _text("store", tables.get("store", ""), folder), tables.get("streams", {})
        if not isinstance(streams, Mapping):
            raise FleetError(f"streams must be tables [streams.NAME], got {reprlib.repr(streams)}")
        return cls(
            _text("name", tables["name"], folder),
            store if not store or "://" in store else str(folder / store),
            _number("every", tables.get("every", _EVERY), folder),
            _count("nodes", tables.get("nodes", 1)),
            _text("registry", tables.get("registry", ""), folder),
            _path("keys", tables.get("keys", ""), folder),
            {name: StreamSpec.parse(name, table, folder) for name, table in streams.items()},
        )


# --- values of a file ------------------------------------------------------------------------------


def _text(key: str, value: object, _: Path) -> str:
    if not isinstance(value, str):
        raise FleetError(f"{key} must be a text, got {reprlib.repr(value)}")
    return value


def _path(key: str, value: object, folder: Path) -> str:
    text = _text(key, value, folder)
    return str(folder / text) if text else ""


def _number(key: str, value: object, _: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FleetError(f"{key} must be a number, got {reprlib.repr(value)}")
    return float(value)


def _count(key: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise FleetError(f"{key} must be a whole number, got {reprlib.repr(value)}")
    return value


def _source(key: str, value: object, folder: Path) -> str:
    """A source; the path of a file or folder is made absolute, because its node has another working folder."""
    source = _text(key, value, folder)
    return source if not source.strip() or is_live(source) or "://" in source else str(folder / source)


def _table(key: str, value: object, _: Path) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise FleetError(f"{key} must be a table, for example {_TABLES[key]}, got {reprlib.repr(value)}")
    return dict(value)


_TABLES = {
    "boxes": "{ anna = [120, 80, 64, 48] }",
    "models": '{ anna = "anna.safetensors" }',
    "labels": '{ site = "north" }',
    "settings": '{ "coreset.size" = 128 }',
}


def _box(_: str, value: object, folder: Path) -> dict[str, Box]:
    return _boxes("boxes", {UNNAMED: value}, folder)


def _boxes(key: str, value: object, folder: Path) -> dict[str, Box]:
    return boxes_by_name(_table(key, value, folder))


def _model(key: str, value: object, folder: Path) -> dict[str, Path]:
    return {UNNAMED: folder / _text(key, value, folder)}


def _models(key: str, value: object, folder: Path) -> dict[str, Path]:
    files = _table(key, value, folder)
    return {check_name(name): folder / _text(f"models.{name}", file, folder) for name, file in files.items()}


def _settings(key: str, value: object, folder: Path) -> dict[str, object]:
    """Settings by full name: `{ coreset = { size = 128 } }` is `{ "coreset.size" = 128 }`."""
    flat: dict[str, object] = {}
    for name, each in _table(key, value, folder).items():
        flat |= {f"{name}.{short}": one for short, one in each.items()} if isinstance(each, Mapping) else {name: each}
    return flat


def _labels(key: str, value: object, folder: Path) -> dict[str, str]:
    return {name: _text(f"labels.{name}", each, folder) for name, each in _table(key, value, folder).items()}


def _follow(key: str, value: object, _: Path) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) and name for name in names):
        raise FleetError(f'{key} must be names of objects, for example ["anna"], got {reprlib.repr(value)}')
    return tuple(dict.fromkeys(check_name(name) for name in names))


#: The field of a stream that each key of its table gives, and the function that reads it.
_READERS: dict[str, tuple[str, Callable[[str, object, Path], Any]]] = {
    "source": ("source", _source),
    "box": ("boxes", _box),
    "boxes": ("boxes", _boxes),
    "model": ("models", _model),
    "models": ("models", _models),
    "settings": ("settings", _settings),
    "cores": ("cores", _number),
    "labels": ("labels", _labels),
    "follow": ("follow", _follow),
}


# --- errors ----------------------------------------------------------------------------------------


def _check_fleet_name(name: object, kind: str) -> None:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise FleetError(
            f"{reprlib.repr(name)} is not a valid name of a {kind}: expected 1 to 64 letters, digits, '_', '-' and "
            "'.', the first of them a letter, a digit or '_'"
        )


def _check_keys(table: Mapping[str, object], known: Collection[str]) -> None:
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            meant = f", did you mean {near[0]!r}?" if near else ":"
            raise FleetError(f"there is no key {key!r}{meant} there are {', '.join(known)}")


@contextmanager
def _errors_about(stream: str) -> Iterator[None]:
    """Turn the errors of catstream into one that names the stream."""
    with _errors_in(f"the stream {stream}"):
        yield


@contextmanager
def _errors_in(place: str) -> Iterator[None]:
    try:
        yield
    except CatstreamError as error:
        raise FleetError(f"{place}: {error}") from None


def _toml_problem(error: str, text: str) -> str:
    """A message of the TOML parser with the name of the stream that it is about."""
    if twice := re.search(r"Cannot declare \('streams', '([^']*)'\) twice", error):
        return f"two streams have the name {twice[1]}: give each a name of its own"
    lines = text.splitlines()
    place = re.search(r"line (\d+)", error)
    number = int(place[1]) if place else len(lines)
    headers = [match[1] for line in lines[:number] if (match := _STREAM_HEADER.match(line))]
    stream = f"the stream {headers[-1]}: " if headers else ""
    if "Cannot overwrite a value" in error:
        key = lines[number - 1].partition("=")[0].strip()
        return f"{stream}{key} is given twice, in line {number}: remove one of them"
    return f"{stream}this is not TOML: {error}"

"""The desired state of a fleet: its streams, from a TOML file.

docs/how-to/fleet.md shows an example. Paths are relative to the folder of the file. Every error is a `FleetError` with
the stream, or with the line of invalid TOML.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import re
import reprlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from catstream.base.addresses import is_live
from catstream.base.box import Box
from catstream.base.names import UNNAMED, boxes_by_name, by_name
from catstream.base.settings import Settings, flat, read_toml
from catstream.base.text import listed
from catstream.errors import CatstreamError, FleetError, errors_in
from catstream.output.destinations import SinkOptions, redacted
from catstream.output.options import KEYS, destinations
from catstream.processes.job import Job, changed_setting

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
_HOST_AND_PORT = Annotated[str, Meta(pattern=r"^([A-Za-z0-9_.-]+:[0-9]{1,5})?$")]

#: Type and description of valid values of each key of a fleet.
_FLEET: dict[str, tuple[Any, str]] = {
    "name": (str, "a text"),
    "store": (str, "a text"),
    "every": (Annotated[float, Meta(ge=0, le=3600)], "a number of seconds from 0 to 3600"),
    "registry": (_HOST_AND_PORT, "HOST:PORT of a node, as in 10.0.0.1:5690"),
    "defaults": (dict[str, Any], "a table [defaults]"),
    "streams": (dict[str, Any], "tables [streams.NAME]"),
}

#: Keys that are read only at the start of the fleet.
_AT_START = ("name", "store", "every", "registry")

#: Type and description of valid values of each key of a stream.
_STREAM: dict[str, tuple[Any, str]] = {
    "source": (str, "a text"),
    "box": (Any, ""),
    "boxes": (dict[str, Any], "a table, for example { anna = [120, 80, 64, 48] }"),
    "model": (str, "a text"),
    "models": (dict[str, str], 'a table of texts, for example { anna = "anna.safetensors" }'),
    "settings": (dict[str, Any], 'a table, for example { "coreset.size" = 128 }'),
    "cores": (Annotated[float, Meta(gt=0, le=4096)], "a number above 0"),
    "labels": (dict[str, str], 'a table of texts, for example { site = "north" }'),
} | KEYS


@dataclass(frozen=True)
class StreamSpec:
    """A stream that a fleet should run; FleetError if a value is invalid.

    name      unique in the fleet: 1 to 64 letters, digits, '_', '-' and '.', not '-' or '.' first
    source    source, as for `catstream track`
    boxes     initial boxes of the objects, by name
    models    saved model of each searched object, by name
    settings  values of settings by full name; the fleet sets run.endpoint and run.keys
    cores     cores that Ray reserves
    labels    required labels of its node
    write     destinations of its tracks
    options   options of these destinations
    """

    name: str
    source: str = field(repr=False)  # it may contain a password
    boxes: dict[str, Box] = field(default_factory=dict)
    models: dict[str, Path] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    cores: float = 1.0
    labels: dict[str, str] = field(default_factory=dict)
    write: tuple[str, ...] = field(default=(), repr=False)  # an address may contain a password
    options: SinkOptions = field(default_factory=SinkOptions)

    def __post_init__(self) -> None:
        check_fleet_name(self.name, "stream")
        with errors_in(f"the stream {self.name}", FleetError):
            if not self.source.strip():
                raise FleetError(
                    'missing source: add one as for `catstream track`, for example source = "rtsp://camera/1"'
                )
            for name, box in self.boxes.items():
                with errors_in(f"the box of {listed([name])}", FleetError):
                    box.checked()
            Job(self.source, self.boxes, self.models, settings=Settings.from_values(self.settings))
            _checked({"cores": self.cores}, _STREAM)

    @classmethod
    def parse(
        cls, name: str, table: Mapping[str, object], folder: Path, defaults: Mapping[str, Any] | None = None
    ) -> StreamSpec:
        """Parse the table of a stream in a file in `folder`; missing values are from `defaults`."""
        check_fleet_name(name, "stream")
        with errors_in(f"the stream {name}", FleetError):
            if not isinstance(table, Mapping):
                got = table if isinstance(table, int) else type(table).__name__  # a text may contain a password
                raise FleetError(f"expected a table with a source, got {got}: write [streams.{name}]")
            values: dict[str, Any] = {"source": "", **(defaults or {})} | _checked(table, _STREAM)
            for one, several in (("box", "boxes"), ("model", "models")):
                if one in values and several in values:
                    raise FleetError(f"{one} and {several} are mutually exclusive: write all objects in {several}")
                values.setdefault(several, {UNNAMED: values.pop(one)} if one in values else {})
            source = values["source"]
            if source.strip() and not is_live(source) and "://" not in source:
                values["source"] = str(folder / source)  # the working folder on its node is different
            values["boxes"] = boxes_by_name(values["boxes"])
            values["models"] = {object: folder / file for object, file in by_name(values["models"]).items()}
            values["settings"] = flat(values.get("settings", {}))
            outputs = {key: values.pop(key) for key in KEYS if key in values}
            values["write"], values["options"] = destinations(outputs, folder, name, source)
        return cls(name, **values)

    @cached_property  # the controller reads it twice a second
    def digest(self) -> str:
        """Hash of the source, objects, settings and destinations.

        Settings are compared by value, so an explicit default does not change the hash. Models are compared by path,
        not by content.
        """
        models = {name: str(file) for name, file in self.models.items()}
        boxes = {name: list(map(float, box)) for name, box in self.boxes.items()}
        parts = [self.source, boxes, models, Settings.from_values(self.settings).changed()]
        if self.write:
            parts += [self.write, msgspec.to_builtins(self.options, enc_hook=str)]
        return _hash(parts)

    @cached_property
    def order(self) -> str:
        """The digest and a hash of the placement: if it changes, the actor of the stream is restarted."""
        return f"{self.digest}/{_hash([self.cores, self.labels])}"


@dataclass(frozen=True, slots=True)
class FleetSpec:
    """The desired state of a fleet.

    name     name of the fleet, with the rules of a stream's name
    store    folder or URL of the states; "" for a folder of the fleet
    every    interval in seconds between two states of a stream in the store; 0 for a limit of 9 GB a day
    registry HOST:PORT of the registry; "" for the head of the cluster, and the default port
    streams  streams by name
    """

    name: str
    store: str = ""
    every: float = 0.0
    registry: str = ""
    streams: dict[str, StreamSpec] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fleet_name(self.name, "fleet")
        with errors_in(f"the fleet {self.name}", FleetError):
            _checked({key: getattr(self, key) for key in _AT_START}, _FLEET)
            writers: dict[str, str] = {}
            for name, dest in ((name, dest) for name, stream in self.streams.items() for dest in stream.write):
                first = writers.setdefault(dest, name)
                if first != name and not dest.startswith("http"):  # streams may share a webhook
                    where = redacted(dest)
                    raise FleetError(f"the streams {first} and {name} write to {where}: put {{stream}} into write")

    @classmethod
    def load(cls, path: Path) -> FleetSpec:
        """Read the file of a fleet; FleetError if it has no streams, or an invalid key or value."""
        tables = read_toml(path, FleetError)
        with errors_in(str(path), FleetError):
            values, folder = {"name": path.stem} | _checked(tables, _FLEET), path.parent.absolute()
            if not values.get("streams"):
                raise FleetError(
                    'missing streams: add a table for each, for example [streams.cam-1] with source = "demo:1"'
                )
            if (store := values.get("store")) and "://" not in store:
                values["store"] = str(folder / store)
            with errors_in("the defaults", FleetError):
                defaults = _checked(values.pop("defaults", {}), _STREAM)
            tables = values.pop("streams")
            streams = {name: StreamSpec.parse(name, table, folder, defaults) for name, table in tables.items()}
            return cls(**values, streams=streams)

    def check_follows(self, earlier: FleetSpec) -> None:
        """Raise FleetError if this spec cannot replace an earlier one of the fleet, whose states remain in use."""
        if self.store != earlier.store:
            raise FleetError(
                f"the store of fleet {self.name} cannot change while it runs (now {earlier.store!r}, file "
                f"{self.store!r}): end the fleet first (catstream fleet down), and copy the states"
            )
        for name in self.streams.keys() & earlier.streams.keys():
            before, after = (Settings.from_values(spec.streams[name].settings) for spec in (earlier, self))
            if changed := changed_setting(before, after):
                raise FleetError(
                    f"stream {name} was started with {changed}, nothing was changed: keep the setting, or first remove "
                    f"the stream with its models (catstream fleet remove {name} --forget)"
                )

    def without(self, names: Collection[str]) -> dict[str, StreamSpec]:
        """Return the streams except the named ones; FleetError if a name is unknown."""
        for name in names:
            if name not in self.streams:
                streams = ", ".join(self.streams) or "none"
                raise FleetError(f"no stream named {name!r} in the fleet {self.name} (streams: {streams})")
        return {name: stream for name, stream in self.streams.items() if name not in names}

    def changes(self, new: FleetSpec, ended: Collection[str], *, are_running: bool) -> list[str]:
        """Describe the changes if a new spec replaces this one, a line for each stream and key."""
        same = "is unchanged" if are_running else "continues from its last state"
        lines = []
        for name in sorted(self.streams.keys() | new.streams.keys()):
            before, after = self.streams.get(name), new.streams.get(name)
            if before is None or after is None:
                lines.append(f"{name}: is {'added' if before is None else 'removed'}")
            elif before.order != after.order:
                lines.append(f"{name}: starts again with its changes")
            else:
                lines.append(f"{name}: {'has ended' if name in ended else same}")
        later = [key for key in _AT_START if getattr(self, key) != getattr(new, key)]
        return lines + [f"{key} changes at the next start, after catstream fleet down" for key in later if are_running]


def _hash(parts: object) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def to_json(spec: FleetSpec) -> bytes:
    """Encode a spec as JSON. It contains the sources with their passwords."""
    return msgspec.json.encode(spec, enc_hook=str)


def from_json(data: bytes) -> FleetSpec:
    """Decode a spec; FleetError if it is damaged."""
    try:
        return msgspec.json.decode(data, type=FleetSpec, dec_hook=lambda part, value: part(value))
    except (msgspec.DecodeError, RecursionError, CatstreamError):
        raise FleetError("the stored streams of the fleet are damaged: apply the fleet file again") from None


def _checked(values: Mapping[str, object], kinds: Mapping[str, tuple[Any, str]]) -> dict[str, Any]:
    """Convert the values of keys; FleetError if a key is unknown, or the type of a value is invalid."""
    checked = {}
    for key, value in values.items():
        if key not in kinds:
            near = difflib.get_close_matches(key, kinds, n=1)
            meant = f", did you mean {near[0]!r}?" if near else ":"
            raise FleetError(f"unknown key {key!r}{meant} expected {', '.join(kinds)}")
        kind, meaning = kinds[key]
        try:
            checked[key] = msgspec.convert(value, kind)
        except msgspec.ValidationError:
            # A list of sources may contain a password.
            text = "a list" if key == "source" and isinstance(value, list) else reprlib.repr(value)
            raise FleetError(f"{key} must be {meaning}, got {text}") from None
    return checked


def check_fleet_name(name: object, kind: str) -> None:
    """Raise FleetError if a name of a fleet or of a stream is invalid."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise FleetError(
            f"{reprlib.repr(name)} is not a valid name of a {kind}: expected 1 to 64 letters, digits, '_', '-' and "
            "'.', the first of them a letter, a digit or '_'"
        )

"""The table of options of destinations: options of `catstream sink`, and keys of a fleet's file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from catstream.base.addresses import without_password
from catstream.errors import SettingsError, errors_in
from catstream.output.destinations import STDOUT, Rotation, SinkOptions, check_sink, kind_of
from catstream.output.events import KINDS, WHEN, Point, check_zones

_LONGEST_SECONDS = 86400.0  # maximum value of "lost"

_UNITS = {"h": 3600.0, "d": 86400.0, "MB": 1e6, "GB": 1e9}
_LOGS = (".ndjson", ".csv")
_MQTT, _HTTP, _FOLDER = ("mqtt://", "mqtts://"), ("http://", "https://"), ("/",)


def parse_zones(zones: Mapping[str, str]) -> dict[str, tuple[Point, ...]]:
    """Parse the corners of zones; SettingsError if a zone is invalid.

    >>> parse_zones({"door": "300,80 420,80 420,400"})
    {'door': ((300.0, 80.0), (420.0, 80.0), (420.0, 400.0))}
    """
    parsed = {}
    for name, text in zones.items():
        try:
            parsed[name] = tuple((float(x), float(y)) for x, y in (corner.split(",") for corner in text.split()))
        except ValueError:
            raise SettingsError(f"expected the corners of {name} as X,Y X,Y X,Y ..., got {text!r}") from None
    check_zones(parsed)
    return parsed


def parse_when(text: str) -> dict[str, float]:
    """Parse kinds of events, with the seconds of `lost`; SettingsError if the text is invalid.

    >>> parse_when("lost=10,entered")
    {'lost': 10.0, 'entered': 0.0}
    """
    kinds = dict(part.strip().partition("=")[::2] for part in text.split(","))
    if set(kinds) - set(KINDS) or any(kinds[kind] for kind in set(kinds) - {"lost"}):
        raise SettingsError(f"expected some of {', '.join(KINDS)}, as in lost=10,entered, got {text!r}")
    try:
        when = {kind: float(seconds or WHEN[kind]) for kind, seconds in kinds.items()}
    except ValueError:
        when = {"lost": -1.0}
    if not 0 <= when.get("lost", 0.0) <= _LONGEST_SECONDS:
        raise SettingsError(f"expected 0 to {_LONGEST_SECONDS:g} seconds, as in lost=10, got {text!r}")
    return when


def parse_rotation(text: str) -> Rotation:
    """Parse the period or size of a rotated log; SettingsError if the text is invalid.

    >>> parse_rotation("1d"), parse_rotation("500MB")
    (Rotation(seconds=86400.0, bytes=inf), Rotation(seconds=inf, bytes=500000000.0))
    """
    if not (match := re.fullmatch(r"([1-9]\d*)(h|d|MB|GB)", text)):
        raise SettingsError(f"expected a time or a size such as 12h, 1d, 500MB or 2GB, got {text!r}")
    size = int(match[1]) * _UNITS[match[2]]
    return Rotation(size, inf) if match[2] in "hd" else Rotation(inf, size)


@dataclass(frozen=True, slots=True)
class Option:
    """A row of the table. Its name is a field of `SinkOptions`, a key of a file, and an option of the command line.

    kind      type of a value
    expected  description of valid values, for an error
    metavar   placeholder for the value in the help; empty for a flag
    help      a line of the help
    users     keys of `SINKS` of the destinations with this option
    convert   converts a value to the field of `SinkOptions`
    """

    kind: Any
    expected: str
    metavar: str
    help: str
    users: tuple[str, ...]
    convert: Callable[[Any], Any] = lambda value: value


OPTIONS = {
    "zone": Option(
        dict[str, str],
        'a table of corners in pixels, for example { door = "300,80 420,80 420,400" }',
        'NAME="X,Y X,Y ..."',
        "A polygon in pixels; repeatable.",
        _MQTT + _HTTP + _FOLDER,
        parse_zones,
    ),
    "when": Option(
        str,
        'a text, for example "lost=10,entered"',
        "EVENT,...",
        f"Send only these events: {', '.join(KINDS)}; lost=10 after 10 s without a box or source, default: 2.",
        _MQTT + _HTTP + _FOLDER,
        parse_when,
    ),
    "picture": Option(bool, "true or false", "", "Add the pipeline's newest picture to each event.", _MQTT + _HTTP),
    "rate": Option(
        Annotated[float, Meta(gt=0, le=1000)],
        "a number above 0 and at most 1000",
        "N",
        "States of each object per second, for mqtt://; default: 1.",
        _MQTT,
    ),
    "secret_file": Option(
        str, "the name of a file", "FILE", "File with the key that signs events, for http://.", _HTTP, Path
    ),
    "megabytes": Option(
        Annotated[float, Meta(gt=0)],
        "a number above 0",
        "N",
        "Size of a folder above which its oldest pictures are removed; default: 1000.",
        _FOLDER,
    ),
    "rotate": Option(
        str,
        'a text, for example "1d" or "500MB"',
        "1d|500MB",
        "Rotate the NDJSON and CSV files of a live source.",
        _LOGS,
        parse_rotation,
    ),
    "keep": Option(
        Annotated[int, Meta(ge=1)],
        "a whole number of at least 1",
        "N",
        "Rotated files that are kept of each; default: all.",
        _LOGS,
    ),
}

#: Types and descriptions of valid values, by the key of a fleet's file.
KEYS: dict[str, tuple[Any, str]] = {
    "write": (list[Annotated[str, Meta(min_length=1)]], 'destinations, for example ["tracks/{stream}.ndjson"]'),
    **{name: (option.kind, option.expected) for name, option in OPTIONS.items()},
}


def parse(values: Mapping[str, Any], destinations: Sequence[str], name_of: Callable[[str], str] = str) -> SinkOptions:
    """Return the options of destinations from values by the names in the table.

    SettingsError if a value is invalid or has no effect on these destinations; `name_of` returns a name for the user.
    """
    kinds, fields = {kind_of(dest) for dest in destinations}, {}
    for name, value in values.items():
        option = OPTIONS[name]
        if kinds.isdisjoint(option.users):
            users = " or ".join(option.users)
            always = " (a folder always has pictures)" if name == "picture" and "/" in kinds else ""
            raise SettingsError(f"{name_of(name)} has no effect on these destinations{always}: omit it, or add {users}")
        with errors_in(name_of(name), SettingsError):
            try:
                fields[name] = option.convert(msgspec.convert(value, option.kind, strict=False))
            except msgspec.ValidationError:
                raise SettingsError(f"must be {option.expected}, got {value!r}") from None
    options = SinkOptions(**fields)
    zone_events = [kind for kind in ("entered", "left") if kind in options.when]
    if "when" in values and zone_events and not options.zone:
        when, zone = name_of("when"), name_of("zone")
        raise SettingsError(f"{when} {','.join(zone_events)} has no effect without a zone: add {zone}")
    if options.zone and not zone_events and kinds.isdisjoint(_MQTT):  # MQTT states contain zones
        raise SettingsError(f"{name_of('zone')} has no effect: add entered or left to {name_of('when')}")
    return options


def destinations(
    values: Mapping[str, Any], folder: Path, stream: str, source: str
) -> tuple[tuple[str, ...], SinkOptions]:
    """Return the destinations of a stream and their options, from the `KEYS` of a file in a folder.

    Paths are relative to the folder, and `{stream}` is replaced by the name of the stream. SettingsError if a value is
    invalid.
    """

    def located(path: str) -> str:
        return f"{folder / path}/" if path.endswith("/") else str(folder / path)

    named = dict.fromkeys(dest.replace("{stream}", stream) for dest in values.get("write", ()))
    destinations = tuple(dest if "://" in dest or dest == STDOUT else located(dest) for dest in named)
    rest = {name: value for name, value in values.items() if name != "write"}
    if "secret_file" in rest:
        rest["secret_file"] = located(rest["secret_file"].replace("{stream}", stream))
    options = parse(rest, destinations)
    with errors_in("write", SettingsError):
        for dest in destinations:
            if dest == STDOUT:
                raise SettingsError("a fleet has no standard output: pass a file or an address")
            check_sink(dest, options, without_password(source))
    return destinations, options

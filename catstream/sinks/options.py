"""The options of destinations: their keys in a file, and the check that each of them has an effect."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from catstream.base.addresses import without_password
from catstream.errors import CatstreamError, SettingsError
from catstream.jobs.job import SinkOptions
from catstream.sinks.destinations import SINKS, STDOUT, check_sink, is_file, sink_of
from catstream.sinks.events import KINDS, check_zones

_LONGEST_SECONDS = 86400.0  # without a box, after which an object is lost

#: The type of each key of a file, and what its value must be.
KEYS: dict[str, tuple[Any, str]] = {
    "write": (list[Annotated[str, Meta(min_length=1)]], 'destinations, for example ["tracks/{stream}.ndjson"]'),
    "zones": (
        dict[Annotated[str, Meta(min_length=1)], tuple[tuple[float, float], ...]],
        "polygons in pixels, for example { door = [[300, 80], [420, 80], [420, 400]] }",
    ),
    "zone_margin": (Annotated[float, Meta(ge=0, le=10000)], "a number of pixels from 0 to 10000"),
    "when": (str, 'a text, for example "lost=10,entered"'),
    "rate": (Annotated[float, Meta(gt=0, le=1000)], "a number above 0 and at most 1000"),
    "picture": (bool, "true or false"),
    "secret_file": (str, "a text"),
    "events_folder": (str, 'a text, for example "events/{stream}"'),
    "events_megabytes": (Annotated[float, Meta(gt=0)], "a number above 0"),
}

#: Field of `SinkOptions` -> the key that sets it.
_KEY_OF = {
    "zones": "zones",
    "margin": "zone_margin",
    "events": "when",
    "lost_seconds": "when",
    "rate": "rate",
    "picture": "picture",
    "key": "secret_file",
    "folder": "events_folder",
    "folder_megabytes": "events_megabytes",
}


def destinations(
    values: Mapping[str, Any], folder: Path, stream: str, source: str
) -> tuple[tuple[str, ...], SinkOptions]:
    """The destinations of a stream and their options, from keys whose values have their types; see `resolved`."""
    fields = {field: values[key] for field, key in _KEY_OF.items() if key in values}
    if "when" in values:
        with _errors_of("when"):
            fields["events"], fields["lost_seconds"] = parse_when(values["when"])
    for field in {"key", "folder"} & fields.keys():
        fields[field] = Path(fields[field])
    return resolved(values.get("write", ()), SinkOptions(**fields), folder, stream, source)


def resolved(
    write: Iterable[str], options: SinkOptions, folder: Path, stream: str, source: str
) -> tuple[tuple[str, ...], SinkOptions]:
    """Return the destinations and options of a stream: paths are in `folder`, and `{stream}` is the stream's name.

    SettingsError if one is invalid.
    """

    def placed(path: Path | None) -> Path | None:
        return path and folder / str(path).replace("{stream}", stream)

    options = replace(options, key=placed(options.key), folder=placed(options.folder))
    named = dict.fromkeys(place.replace("{stream}", stream) for place in write)
    places = [*(str(folder / place) if is_file(place) else place for place in named), *options.places]
    with _errors_of("write"):
        for place in places:
            if place == STDOUT:
                raise SettingsError("there is no standard output: pass a file or an address")
            check_sink(place, options, without_password(source))
    check_options(options, places)
    return tuple(places), options


@contextmanager
def _errors_of(key: str) -> Iterator[None]:
    """Turn each error into a SettingsError that names the key."""
    try:
        yield
    except CatstreamError as error:
        raise SettingsError(f"{key}: {error}") from None


def parse_when(text: str) -> tuple[tuple[str, ...], float]:
    """Return the kinds of events, and the seconds of `lost`; SettingsError if the text is invalid.

    >>> parse_when("lost=10,entered")
    (('lost', 'entered'), 10.0)
    """
    kinds = dict(part.strip().partition("=")[::2] for part in text.split(","))
    try:
        seconds = float(kinds.get("lost") or SinkOptions().lost_seconds)
    except ValueError:
        seconds = -1.0
    if set(kinds) - set(KINDS) or any(kinds[kind] for kind in set(kinds) - {"lost"}):
        raise SettingsError(f"expected some of {', '.join(KINDS)}, as in lost=10,entered, got {text!r}")
    if not 0 <= seconds <= _LONGEST_SECONDS:
        raise SettingsError(f"expected 0 to {_LONGEST_SECONDS:g} seconds, as in lost=10, got {text!r}")
    return tuple(kinds), seconds


def check_options(
    options: SinkOptions,
    places: Iterable[str],
    size: tuple[int, int] | None = None,
    names: Mapping[str, str] = _KEY_OF,
) -> None:
    """Raise SettingsError if an option has no effect on these destinations.

    With the `size` of a frame, also if the margin is larger. `names` are those that the user knows the fields by.
    """
    default, used = SinkOptions(), {name for place in places for name in sink_of(place).options}
    for name, flag in names.items():
        if getattr(options, name) != getattr(default, name) and name not in used:
            users = " or ".join(scheme for scheme, row in SINKS.items() if name in row.options)
            users = users.replace("folder://", names["folder"])
            raise SettingsError(f"{flag} has no effect on these destinations: add one with {users}, or omit it")
    zones, when, margin = names["zones"], names["events"], names["margin"]
    of_zones = [kind for kind in ("entered", "left") if kind in options.events]
    if of_zones and options.events != default.events and not options.zones:
        raise SettingsError(f"{when} {','.join(of_zones)} has no effect without a zone: add {zones}")
    if options.margin != default.margin and not options.zones:
        raise SettingsError(f"{margin} has no effect without a zone: add {zones}")
    if options.zones and not of_zones and "rate" not in used:  # states, which it is for, have zones, too
        raise SettingsError(f"{zones} has no effect: add entered or left to {when}")
    check_zones(options.zones, size)
    if size is not None and options.margin > max(size):
        raise SettingsError(f"{margin} {options.margin:g} is larger than the frame: no object can leave a zone")

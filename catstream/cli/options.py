"""The parameter types and options that several commands share, each with one help text.

The decorators of the first part add one option. The others add several options, and pass them on as one argument of
the command's function.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any

import click

from catstream.base.names import boxes_by_name, split_name
from catstream.base.settings import PRESETS, Settings
from catstream.errors import ObjectError

Command = Callable[..., Any]
Decorator = Callable[[Command], Command]
_Converter = Callable[[dict[str, str]], object]

#: Parameter type of a file or folder.
PATH = click.Path(path_type=Path)

#: Parameter type of a folder, which may not exist.
FOLDER = click.Path(path_type=Path, file_okay=False)


class NumberRange(click.FloatRange):
    """A number within bounds; rejects NaN, which is neither below nor above a bound."""

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> float:
        number: float = super().convert(value, parameter, context)
        if math.isnan(number):
            self.fail(f"expected a number, got {value!r}", parameter, context)
        return number


with_overwrite = click.option("--overwrite", is_flag=True, help="Replace existing files.")
with_json = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
with_keys = click.option(
    "--keys", default="", metavar="DIR", help="Folder of keys, if the pipeline or fleet requires keys."
)


def _collect(flag: str, convert: _Converter) -> Callable[..., object]:
    """A callback that collects texts [NAME=]VALUE by name, and returns the result of `convert`."""

    def by_name(_: click.Context, __: click.Parameter, texts: tuple[str, ...]) -> object:
        values: dict[str, str] = {}
        for text in texts:
            name, value = split_name(text)
            if name in values:
                earlier = f"{name}={values[name]}" if name else values[name]
                hint = "its own name" if name else f"a name, NAME={value}"
                raise ObjectError(f"duplicate object ({flag}{earlier}, {flag}{text}): give each object {hint}")
            values[name] = value
        return convert(values)

    return by_name


def _by_name(flag: str, argument: str, metavar: str, convert: _Converter, help: str) -> Decorator:
    """A repeatable option for objects."""
    callback = _collect(f"{flag} ", convert)
    return click.option(flag, argument, multiple=True, metavar=metavar, callback=callback, help=help)


def with_files(flag: str, argument: str, help: str) -> Decorator:
    """Add a repeatable option [NAME=]FILE, as a dict of files by object."""
    return _by_name(flag, argument, "[NAME=]FILE", lambda files: {name: Path(files[name]) for name in files}, help)


with_model = with_files("--model", "models", "Search for the object of a saved model.")

#: Adds boxes as the argument `boxes`, a dict by name.
with_boxes = click.argument(
    "boxes", nargs=-1, required=True, metavar="[NAME=]X,Y,W,H...", callback=_collect("", boxes_by_name)
)

_HELP = "An object in the first frame; repeatable."
_with_box = _by_name("--box", "boxes", "[NAME=]X,Y,W,H", boxes_by_name, _HELP)


def with_object(command: Command) -> Command:
    """Add the repeatable options `--box` and `--model`, as the arguments `boxes` and `models`: dicts by name."""
    return _with_box(with_model(command))


def combined(argument: str, value: Callable[..., object], *options: Decorator) -> Decorator:
    """Add options, and pass on the result of `value` as one argument.

    The parameters of `value` are the names of the options, or of the argument of another `combined` decorator above
    this one or among `options`.
    """
    names = list(signature(value).parameters)

    def decorate(command: Command) -> Command:
        @wraps(command)
        def wrapped(**options: object) -> object:
            combination = value(**{name: options.pop(name) for name in names})
            return command(**{argument: combination}, **options)

        whole: Command = wrapped
        for option in reversed(options):
            whole = option(whole)
        return whole

    return decorate


#: Adds `--start`, `--end` and `--stride`, as the argument `part`, a slice.
with_part = combined(
    "part",
    lambda start, end, stride: slice(start, end, stride),
    click.option("--start", type=click.IntRange(0), metavar="N", help="First frame, for a file or folder."),
    click.option("--end", type=click.IntRange(0), metavar="N", help="Stop before this frame."),
    click.option("--stride", type=click.IntRange(1), metavar="N", help="Track only every N-th frame."),
)

#: Adds `--settings`, `--preset` and `--set`, as the argument `overrides`: a dict of settings.
with_overrides = combined(
    "overrides",
    lambda file, preset, pairs: Settings.collect(preset=preset, file=file, overrides=pairs),
    click.option("--settings", "file", type=PATH, help="TOML file of settings."),
    click.option("--preset", type=click.Choice(list(PRESETS)), metavar="NAME", help=f"Settings: {', '.join(PRESETS)}."),
    click.option("--set", "pairs", multiple=True, metavar="GROUP.NAME=VALUE", help="Set one setting; repeatable."),
)

#: Adds the same options, as the argument `settings`: all settings, with defaults for the others.
with_settings = combined("settings", lambda overrides: Settings.from_values(overrides), with_overrides)


#: Adds `--skip-damaged`, a setting for reading a source, to the argument `overrides`.
with_reading = combined(
    "overrides",
    lambda overrides, skip_damaged: overrides | ({"run.skip_damaged": True} if skip_damaged else {}),
    click.option("--skip-damaged", is_flag=True, help="Continue after a damaged part of a video."),
)

"""`catstream settings`: list the settings."""

from __future__ import annotations

import json
import sys

import click

from catstream.cli.output import screen, table
from catstream.errors import SettingsError
from catstream.services.options import with_json
from catstream.settings import describe


@click.command()
@click.argument("words", nargs=-1, metavar="[WORD]...")
@with_json
def settings(words: tuple[str, ...], as_json: bool) -> None:
    """List the settings with their defaults and descriptions.

    With words, only those whose name or description has all of them. If the output is no terminal, there is one line
    for each setting, its columns separated by tabs.

    Set them with --set GROUP.NAME=VALUE, in a TOML file with a table for each group (--settings FILE), or in the
    environment (CATSTREAM_GROUP_NAME).

    \b
    EXAMPLES
      catstream settings
      catstream settings coreset
      catstream settings | grep size
      catstream settings --json | jq -r '.[].name'
    """
    rows = [row for row in describe() if all(word.lower() in f"{row[0]} {row[3]}".lower() for word in words)]
    if not rows:
        raise SettingsError(f"no setting has {' and '.join(map(repr, words))} in its name or description")
    if as_json:
        keys = ("name", "takes", "default", "meaning")
        click.echo(json.dumps([dict(zip(keys, row, strict=True)) for row in rows], indent=2))
        return
    if not sys.stdout.isatty():
        for name, takes, default, meaning in rows:
            click.echo(f"{name}\t{default}\t{takes}\t{meaning}")
        return
    shown = table("setting", "default", "takes", "meaning")
    for name, takes, default, meaning in rows:
        shown.add_row(name, str(default), takes, meaning)
    screen().print(shown)

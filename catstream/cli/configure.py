"""`catstream settings`: the list of settings."""

from __future__ import annotations

import json
import sys

import click

from catstream.base.settings import RESUMABLE, describe
from catstream.cli.common import screen, table
from catstream.cli.options import with_json
from catstream.errors import SettingsError


@click.command()
@click.argument("words", nargs=-1, metavar="[WORD]...")
@with_json
def settings(words: tuple[str, ...], as_json: bool) -> None:
    """List the settings with their defaults and descriptions.

    With words, only those whose name or description has all of them. Set them
    with --set GROUP.NAME=VALUE, in a TOML file with a table for each group
    (--settings FILE), or in the environment (CATSTREAM_GROUP_NAME).

    \b
    EXAMPLES
      catstream settings
      catstream settings coreset
      catstream settings --json | jq -r '.[].name'
    """
    matches = [
        setting
        for setting in describe().values()
        if all(word.lower() in f"{setting.name} {setting.about}".lower() for word in words)
    ]
    if not matches:
        raise SettingsError(f"no setting has {' and '.join(map(repr, words))} in its name or description")
    if as_json:
        keys = ("name", "takes", "default", "about")
        rows = [
            {key: getattr(setting, key) for key in keys} | {"resumable": setting.name in RESUMABLE}
            for setting in matches
        ]
        click.echo(json.dumps(rows, indent=2))
        return
    if not sys.stdout.isatty():
        for setting in matches:
            click.echo(f"{setting.name}\t{setting.default}\t{setting.takes}\t{setting.about}")
        return
    listing = table("setting", "default", "takes", "meaning")
    for setting in matches:
        listing.add_row(setting.name, str(setting.default), setting.takes, setting.about)
    screen().print(listing)

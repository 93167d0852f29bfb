"""`catstream keys` and `settings`: the keys and roles of clients, and the list of settings."""

from __future__ import annotations

import json
import sys
from itertools import groupby
from pathlib import Path

import click

from catstream.base.settings import describe
from catstream.cli.common import CommandGroup, screen, table
from catstream.cli.options import PATH, with_json
from catstream.errors import SettingsError
from catstream.wire.channels import CHANNELS, Role
from catstream.wire.keys import ROLES, allow, clients, create, revoke

_folder = click.argument("folder", metavar="DIR", type=PATH)
_name = click.argument("name")


@click.group(cls=CommandGroup)
def keys() -> None:
    """Manage the keys of a pipeline and its clients.

    With keys, all connections are encrypted, and only clients with an allowed
    key can connect. A pipeline that other machines can reach requires keys.

    \b
    EXAMPLES
      catstream keys new keys
      catstream track walk.mp4 --box 120,80,64,48 --set run.endpoint=tcp://0.0.0.0:5700 --set run.keys=keys
      catstream keys allow keys phone --output phone-keys
      catstream watch tracks --endpoint tcp://10.0.0.1:5700 --keys phone-keys
      catstream keys list keys
      catstream keys revoke keys phone
    """


@keys.command()
@_folder
def new(folder: Path) -> None:
    """Make the keys of a pipeline.

    DIR gets the key pair of the listening sockets, the key pair of the
    pipeline's own processes, and the list of clients. Only you can read its
    files, and no file is overwritten.
    """
    create(folder)
    click.echo(f"made {folder}: start the pipeline with --set run.keys={folder}")


@keys.command(name="allow")
@_folder
@_name
@click.option("--role", type=click.Choice(ROLES), default="watch", show_default=True, help="Role of the client.")
@click.option("--output", type=PATH, help="Folder for the new keys of the client.")
@click.option("--public", metavar="KEY", help="Public key of a client that already has a key pair.")
def allow_(folder: Path, name: str, role: Role, output: Path | None, public: str | None) -> None:
    """Allow a client to connect.

    Transfer the folder OUTPUT to the client over a secure channel, and remove it
    here. Running pipelines need no restart.

    \b
    ROLE
      watch     subscribe to all channels
      control   the same, and send commands to a running pipeline
      pipeline  everything: the pipeline's own processes

    \b
    EXAMPLES
      catstream keys allow keys phone --output phone-keys
      catstream keys allow keys desk --role control --public 'Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID'
    """
    if (output is None) == (public is None):
        raise click.UsageError("pass --output DIR for a new key pair, or --public KEY for the key pair of the client")
    allow(folder, name, role, output, public)
    click.echo(f"{name} may connect as {role}" + (f" with the keys in {output}: transfer them to it" if output else ""))


@keys.command(name="list")
@_folder
def list_(folder: Path) -> None:
    """List the clients that may connect."""
    for name, client in clients(folder).items():
        rank = ROLES.index(client.role)
        channels = (channel.name for channel in CHANNELS.values() if ROLES.index(channel.role) <= rank)
        click.echo(f"{name:16} {client.role:9} {client.public}  {', '.join(channels)}")


@keys.command(name="revoke")
@_folder
@_name
def revoke_(folder: Path, name: str) -> None:
    """Revoke the key of a client.

    Running pipelines need no restart. Open connections stay open until they
    end; restart the pipeline to close them now.
    """
    revoke(folder, name)
    click.echo(f"{name} can no longer connect; open connections stay open until they end")


@click.command()
@click.argument("words", nargs=-1, metavar="[WORD]...")
@with_json
def settings(words: tuple[str, ...], as_json: bool) -> None:
    """List the settings with their defaults and descriptions.

    With words, only those whose name or description has all of them. Set them
    with --set GROUP.NAME=VALUE, in a TOML file with a table for each group
    (--settings FILE), or in the environment (CATSTREAM_GROUP_NAME). Expert
    settings, for experiments and the presets of the paper, come last.

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
    matches.sort(key=lambda setting: setting.expert)
    if as_json:
        keys = ("name", "takes", "default", "about", "expert", "resumable")
        click.echo(json.dumps([{key: getattr(setting, key) for key in keys} for setting in matches], indent=2))
        return
    if not sys.stdout.isatty():
        for setting in matches:
            click.echo(f"{setting.name}\t{setting.default}\t{setting.takes}\t{setting.about}")
        return
    for expert, group in groupby(matches, key=lambda setting: setting.expert):
        rows = table("expert setting" if expert else "setting", "default", "takes", "meaning")
        for setting in group:
            rows.add_row(setting.name, str(setting.default), setting.takes, setting.about)
        screen().print(rows)

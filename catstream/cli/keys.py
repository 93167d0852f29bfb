"""`catstream keys`: the keys of a pipeline and of its clients."""

from __future__ import annotations

from pathlib import Path

import click

from catstream.cli.options import PATH
from catstream.wire.channels import Role
from catstream.wire.keys import ROLES, allow, create

_folder = click.argument("folder", metavar="DIR", type=PATH)


@click.group()
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
      cat keys/clients/phone    # its role and public key
      rm keys/clients/phone     # revoke its key
    """


@keys.command()
@_folder
def new(folder: Path) -> None:
    """Make the keys of a pipeline in the folder DIR, which only you can read."""
    create(folder)
    click.echo(f"made {folder}: start the pipeline with --set run.keys={folder}")


@keys.command(name="allow")
@_folder
@click.argument("name")
@click.option("--role", type=click.Choice(ROLES), default="watch", show_default=True, help="Role of the client.")
@click.option("--output", type=PATH, required=True, help="New folder for the keys of the client.")
def allow_(folder: Path, name: str, role: Role, output: Path) -> None:
    """Make the keys of a client, and allow it to connect.

    Transfer the folder OUTPUT to the client over a secure channel, and remove it
    here. Running pipelines need no restart. The role "watch" subscribes to all
    channels, "control" also sends commands, and "pipeline" may do everything.

    \b
    EXAMPLES
      catstream keys allow keys phone --output phone-keys
      catstream keys allow keys desk --role control --output desk-keys
    """
    allow(folder, name, role, output)
    click.echo(f"{name} may connect as {role} with the keys in {output}: transfer them to it")

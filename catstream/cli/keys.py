"""`catstream keys`: who may connect to a pipeline, and as what."""

from __future__ import annotations

from pathlib import Path

import click

from catstream.wire.channels import CHANNELS, Role
from catstream.wire.keys import ROLES, allow, clients, create, revoke

__all__ = ["keys"]

_folder = click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
_name = click.argument("name")


@click.group()
def keys() -> None:
    """Make keys, and say who may connect to a pipeline.

    With keys all that travels is encrypted, and who connects must hold a key that
    is allowed. A pipeline that other machines can reach does not start without.

    \b
    EXAMPLES
      catstream keys new keys
      catstream track walk.mp4 --box 120,80,64,48 --set run.endpoint=tcp://0.0.0.0:5700 --set run.keys=keys
      catstream keys allow keys phone --output phone-keys
      catstream watch tracks --endpoint tcp://10.0.0.1:5700 --keys phone-keys
      catstream keys revoke keys phone
    """


@keys.command()
@_folder
def new(folder: Path) -> None:
    """Make the keys of a pipeline.

    DIR gets the key pair of the sockets that listen, that of the pipeline's own
    processes, and the list of who may connect. Its files are for you alone, and
    nothing is written over. Where the processes run on several machines, each
    needs a copy of it.

    \b
    EXAMPLE
      catstream keys new keys
    """
    create(folder)
    click.echo(f"made {folder}: start the pipeline with --set run.keys={folder}")


@keys.command(name="allow")
@_folder
@_name
@click.option("--role", type=click.Choice(ROLES), default="watch", show_default=True, help="What the client may do.")
@click.option("--output", type=click.Path(path_type=Path), help="Folder for the new keys of the client.")
@click.option("--public", metavar="KEY", help="The public key of a client that has its own already.")
def allow_(folder: Path, name: str, role: Role, output: Path | None, public: str | None) -> None:
    """Let a client connect, from now on.

    Bring the folder OUTPUT to the client, on a way that nobody else can read, and
    remove it here. Running pipelines need no restart.

    \b
    ROLE
      watch     subscribe to tracks, models, samples and health
      steer     watch, and send orders to a running pipeline
      pipeline  all: another machine on which processes of this pipeline run

    \b
    EXAMPLES
      catstream keys allow keys phone --output phone-keys
      catstream keys allow keys desk --role steer --public 'Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID'
    """
    if (output is None) == (public is None):
        raise click.UsageError("give --output, a folder for the new keys of the client, or --public, the key it has")
    allow(folder, name, role, output, public)
    click.echo(f"{name} may connect as {role}" + (f" with the keys in {output}: bring them to it" if output else ""))


@keys.command(name="list")
@_folder
def list_(folder: Path) -> None:
    """Show who may connect.

    \b
    EXAMPLE
      catstream keys list keys
    """
    for name, client in clients(folder).items():
        rank = ROLES.index(client.role)
        channels = (channel.name for channel in CHANNELS.values() if ROLES.index(channel.role) <= rank)
        click.echo(f"{name:16} {client.role:9} {client.public}  {', '.join(channels)}")


@keys.command(name="revoke")
@_folder
@_name
def revoke_(folder: Path, name: str) -> None:
    """Let a client connect no more.

    Running pipelines need no restart. A connection that is open stays until it
    ends: restart the pipeline to end it now.

    \b
    EXAMPLE
      catstream keys revoke keys phone
    """
    revoke(folder, name)
    click.echo(f"{name} can connect no more; a connection that is open lasts until it ends")

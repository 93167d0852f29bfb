"""`catstream fleet head` and `catstream fleet node`: the two commands that run on the machines of a fleet."""

from __future__ import annotations

import logging
import socket
from pathlib import Path

import click

__all__ = ["head", "node"]

#: Default of --ports: the first of the ports of a node.
FIRST_PORT = 6401

_FOLDER = click.Path(path_type=Path, file_okay=False)
_FILE = click.Path(path_type=Path, dir_okay=False)
_ports = click.option(
    "--ports",
    default=FIRST_PORT,
    show_default=True,
    type=click.IntRange(0, 65435),
    metavar="FIRST",
    help="First of the 100 ports of this node, for the rules of a firewall; 0 for any free ones.",
)


@click.command()
@click.option("--listen", required=True, metavar="IP:PORT", help="Private address of this machine, or 127.0.0.1.")
@click.option("--folder", required=True, type=_FOLDER, help="Folder for the token and the state of the cluster.")
@click.option("--registry", default=5690, show_default=True, metavar="PORT", help="Port of the registry.")
@_ports
def head(listen: str, folder: Path, registry: int, ports: int) -> None:
    """Run the head of a fleet, which runs no streams, until SIGTERM.

    \b
      catstream fleet head --listen 10.0.0.1:6400 --folder /var/lib/catstream

    Its first start makes the file `token` in the folder. Everybody who has the token can run code on all nodes.
    """
    from catstream.fleet import keeper

    _log_to_terminal()
    keeper.keep_head(listen, folder, ports, registry)


@click.command()
@click.option("--head", "address", required=True, metavar="IP:PORT", help="Address of the head.")
@click.option("--token-file", required=True, type=_FILE, help="Copy of the head's token; mode 600.")
@click.option("--name", help="Name of the node; the name of this machine by default.")
@click.option("--cores", type=click.FloatRange(0), help="Processor cores for streams; all of this machine by default.")
@click.option(
    "--label", "labels", multiple=True, metavar="KEY=VALUE", help="Label by which streams choose nodes; repeatable."
)
@click.option("--folder", type=_FOLDER, help="Folder for the file NAME.pid; that of the token by default.")
@_ports
def node(
    address: str,
    token_file: Path,
    name: str | None,
    cores: float | None,
    labels: tuple[str, ...],
    folder: Path | None,
    ports: int,
) -> None:
    """Run a node of a fleet until SIGTERM. It waits for the head, and joins it again after the head was restarted.

    \b
      catstream fleet node --head 10.0.0.1:6400 --token-file token --label site=north
    """
    from catstream.fleet import keeper

    _log_to_terminal()
    own = name or socket.gethostname().partition(".")[0]
    keeper.keep_node(address, token_file, folder or token_file.parent, own, cores, _pairs(labels), ports)


def _pairs(labels: tuple[str, ...]) -> dict[str, str]:
    """The labels of the options KEY=VALUE."""
    for label in labels:
        if "=" not in label:
            raise click.UsageError(f"a label is KEY=VALUE, for example site=north, got {label!r}")
    return dict(label.partition("=")[::2] for label in labels)


def _log_to_terminal() -> None:
    logging.basicConfig(format="%(asctime)s %(message)s", datefmt="%Y-%m-%d %H:%M:%S", level=logging.INFO)

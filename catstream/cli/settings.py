"""`catstream settings`: list the settings."""

from __future__ import annotations

import click
from rich.console import Console
from rich.table import Table

from catstream.settings import describe

__all__ = ["settings"]


@click.command()
def settings() -> None:
    """List all settings with their defaults and descriptions.

    Set them with --set GROUP.NAME=VALUE, in a TOML file with a table for each group (--settings FILE), or in the
    environment (CATSTREAM_GROUP_NAME).
    """
    table = Table("setting", "default", "takes", "meaning", box=None, pad_edge=False, header_style="bold")
    for name, takes, default, meaning in describe():
        table.add_row(name, str(default), takes, meaning)
    Console().print(table)

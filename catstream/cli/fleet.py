"""`catstream fleet`: the commands of a fleet, each in a module of its own."""

from __future__ import annotations

from importlib import import_module

import click

__all__ = ["fleet"]

#: Command -> its module and summary; the module is imported when the command is called.
COMMANDS = {
    "head": ("fleet_nodes", "Run the head of a fleet."),
    "node": ("fleet_nodes", "Run a node of a fleet."),
    "view": ("fleet_view", "Watch all streams of a fleet in a browser."),
}


class _Commands(click.Group):
    def list_commands(self, _: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, _: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        command: click.Command = getattr(import_module(f"catstream.cli.{COMMANDS[name][0]}"), name.replace("-", "_"))
        return command

    def format_commands(self, _: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])


@click.command(cls=_Commands)
def fleet() -> None:
    """Run many streams on many machines, found by name."""

"""The command line: a file a verb, or a family of them. Arguments and printing, no algorithm."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import click

from catstream.errors import CatstreamError

__all__ = ["INTERRUPTED", "VERBS", "interruptible", "main", "verb"]

#: Exit code of a command that Ctrl-C ended before it was done.
INTERRUPTED = 130

#: Verb -> what it does. Its module is imported only when it is called: some take long.
VERBS = {
    "track": "Follow an object through a video.",
    "demo": "See it work, on a video that is rendered for it.",
    "evaluate": "Measure accuracy on annotated sequences, beside other trackers.",
    "loadtest": "Put pipelines under load, and measure what they bear.",
    "watch": "Show what a running pipeline says, as it says it.",
    "view": "Look at a running pipeline in a browser, and steer it.",
    "sink": "Write the tracks of a running pipeline to files.",
    "record": "Keep what a running pipeline says, in one file.",
    "replay": "Play a recording to subscribers, or learn from it once more.",
    "status": "Ask a running pipeline how it is.",
    "set-box": "Tell a running pipeline where the object is.",
    "pause": "Have a running pipeline take no more frames.",
    "resume": "Have a paused pipeline go on.",
    "save": "Write what a running pipeline has learned to a file.",
    "stop": "End a running pipeline as if its source had come to its end.",
    "keys": "Make keys, and say who may connect to a pipeline.",
    "settings": "List all settings, with their defaults and meaning.",
}

#: The module of verbs that share one.
_TOGETHER = dict.fromkeys(("set-box", "pause", "resume", "save", "stop"), "steer")


def verb(name: str) -> click.Command:
    """The command of one of the `VERBS`."""
    command: click.Command = getattr(
        import_module(f"catstream.cli.{_TOGETHER.get(name, name)}"), name.replace("-", "_")
    )
    return command


@contextmanager
def interruptible() -> Iterator[None]:
    """End this process at once on Ctrl-C inside a `with`, which is for imports before anything has begun.

    Kernels that are compiled meanwhile swallow a KeyboardInterrupt, or make another error of it.
    """

    def leave(*_: object) -> None:
        os.write(2, b"stopped\n")
        os._exit(INTERRUPTED)

    before = signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Verbs(click.Group):
    def list_commands(self, _: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, _: click.Context, name: str) -> click.Command | None:
        return verb(name) if name in VERBS else None

    def invoke(self, context: click.Context) -> Any:
        try:
            return super().invoke(context)
        except (KeyboardInterrupt, click.Abort):  # which click would take for an error
            click.echo("stopped", err=True)
            context.exit(INTERRUPTED)

    def format_commands(self, _: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Verbs"):
            formatter.write_dl(list(VERBS.items()))


@click.command(cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="catstream", prog_name="catstream")
def group() -> None:
    """Learn to follow one object in a video stream, from a single box, on a CPU.

    \b
      catstream demo
      catstream track walk.mp4 --box 120,80,64,48 --output out --video
    """


def main() -> None:
    """Run the command line: one line for an error, and exit code 1; `INTERRUPTED` after Ctrl-C."""
    try:
        group(prog_name="catstream")
    except CatstreamError as error:
        click.echo(f"catstream: {error}", err=True)
        sys.exit(1)

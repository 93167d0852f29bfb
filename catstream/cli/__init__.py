"""The command line: argument parsing and output, no algorithms."""

from __future__ import annotations

import errno
import io
import os
import sys
from contextlib import suppress
from importlib import import_module
from typing import cast

import click

from catstream.base.addresses import without_passwords
from catstream.cli.common import INTERRUPTS, complain, stopped
from catstream.errors import CatstreamError, ServiceError, require_linux

#: Command -> its module and its summary. A module is imported when its command is called, because some imports are
#: slow.
COMMANDS = {
    "track": ("track", "Track objects in a video."),
    "annotate": ("annotate", "Track objects between boxes at keyframes, and check the tracks."),
    "batch": ("batch", "Track objects in many videos."),
    "demo": ("measure", "Track an object in a rendered demo video."),
    "find": ("models", "Find the objects of saved models in videos, folders and images."),
    "evaluate": ("measure", "Measure the accuracy on annotated sequences."),
    "loadtest": ("loadtest", "Run pipelines under load, and measure latency and losses."),
    "watch": ("attach", "Print the messages of a running pipeline."),
    "view": ("view", "Watch and control a running pipeline in a browser."),
    "sink": ("write", "Write the tracks of a running pipeline to files and elsewhere."),
    "export": ("export", "Convert the log of a run to other formats."),
    "report": ("report", "Write an HTML page about the tracks of a run."),
    "status": ("status", "Show the state of a running pipeline."),
    "set-box": ("attach", "Set the box of an object in a running pipeline."),
    "search": ("attach", "Search for the object of a saved model in a running pipeline."),
    "forget": ("attach", "Stop tracking an object in a running pipeline."),
    "pause": ("attach", "Pause a running pipeline."),
    "resume": ("attach", "Resume a paused pipeline."),
    "save": ("attach", "Save what a pipeline has learned to a file."),
    "merge": ("models", "Merge saved models of one object."),
    "stop": ("attach", "Stop a running pipeline as if its source had ended."),
    "fleet": ("fleet_commands", "Run many streams on one machine or many."),
    "keys": ("keys", "Manage the keys of a pipeline and its clients."),
    "settings": ("configure", "List all settings with their defaults and descriptions."),
}


#: Commands that run on every system; the others start or use the processes of a pipeline.
_PORTABLE = {"annotate", "batch", "find", "evaluate", "export", "report", "merge", "settings"}


def load_command(name: str) -> click.Command:
    """Import the module of one of the `COMMANDS`, and return the click command."""
    if name not in _PORTABLE:
        require_linux()
    module = import_module(f"catstream.cli.{COMMANDS[name][0]}")
    command: click.Command = getattr(module, name.replace("-", "_"))
    return command


class _Commands(click.Group):
    def list_commands(self, _: click.Context) -> list[str]:
        return list(COMMANDS)  # unsorted, for help and reference

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        if name == "track" and not context.resilient_parsing:
            from catstream.processes.start_server import start_server

            with suppress(ServiceError):  # the pipeline raises it again
                start_server()  # it imports while this process imports the command
        return load_command(name) if name in COMMANDS else None

    def invoke(self, context: click.Context) -> object:
        try:
            return super().invoke(context)
        except (KeyboardInterrupt, click.Abort):  # otherwise, click reports an error
            stopped()
        except click.UsageError as error:
            raise click.UsageError(without_passwords(error.format_message()), error.ctx) from None

    def format_commands(self, _: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])


@click.command(
    cls=_Commands, commands=list(map(click.Command, COMMANDS)), context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(package_name="catstream", prog_name="catstream")
def group() -> None:
    """Track objects in a video stream; each is learned online from a single box, on a CPU.

    \b
      catstream demo
      catstream track walk.mp4 --box 120,80,64,48 --output out --video
    """


def main() -> None:
    """Run the command line. The exit code is 1 after an error, which is one line, and 130 after Ctrl-C."""
    INTERRUPTS.install()
    command = " ".join(sys.argv)
    if (shown := without_passwords(command)) != command:
        from catstream.base.system import name_process

        name_process("catstream", shown)
    os.environ["PYTHONSAFEPATH"] = "1"  # child processes import no file of the current folder
    # FFmpeg uses a proxy of the environment even for cameras on this machine.
    os.environ["no_proxy"] = ",".join(filter(None, ("127.0.0.1,localhost", os.environ.get("no_proxy"))))
    if sys.stdout is None:  # closed by the parent (>&-): drop the output
        sys.stdout = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
    cast(io.TextIOWrapper, sys.stdout).reconfigure(errors="surrogateescape")  # names of files need not be UTF-8
    try:
        group(prog_name="catstream")
    except CatstreamError as error:
        complain(error)
        sys.exit(1)
    except PermissionError as error:
        if error.filename is None:  # not about a file
            raise
        complain(f"cannot use {error.filename!r} ({error.strerror}): change its permissions, or use another path")
        sys.exit(1)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        # The interpreter flushes standard output again when it exits, which must not fail a second time.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        complain(f"cannot write any more: {error.strerror}")
        sys.exit(1)
    finally:
        INTERRUPTS.end()

"""`python -P -m catstream.processes NAME`: runs one process of a pipeline.

Each process can be started by hand, in any order, as the three containers do; `catstream track` starts them all.
"""

from __future__ import annotations

from catstream.base.threads import limit_process

limit_process()  # before anything imports numpy

import sys
from typing import Any

import click

from catstream.errors import CatstreamError
from catstream.jobs.job import Job
from catstream.processes.options import PATH, with_object, with_part, with_settings
from catstream.processes.process import run


@click.group(context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
def main() -> None:
    """The processes of a catstream pipeline.

    They connect at an endpoint: a folder for their sockets, or tcp://127.0.0.1:PORT. All need the
    same settings. With -P, Python imports no file from the current folder.

    \b
      mkdir -m 700 run
      python -P -m catstream.processes compressor --set run.endpoint=run &
      python -P -m catstream.processes trainer    --set run.endpoint=run &
      python -P -m catstream.processes detector   --set run.endpoint=run walk.mp4 --box 120,80,64,48
    """


_source = click.argument("source")
_state = click.option("--state", type=PATH, help="Folder for the checkpoints and the desired state.")


@main.command()
@_source
@click.option("--resume", is_flag=True, help="Continue after the last message that a previous detector sent.")
@_state
@with_object
@with_part
@with_settings
def detector(**options: Any) -> None:
    """Track the object in the frames of SOURCE; send tracks and features."""
    sys.exit(run("detector", Job(**options)))


@main.command()
@_state
@with_settings
def compressor(**options: Any) -> None:
    """Compress the features in coreset trees; send samples."""
    sys.exit(run("compressor", Job(**options)))


@main.command()
@with_settings
def trainer(**options: Any) -> None:
    """Train models on the samples; send models."""
    sys.exit(run("trainer", Job(**options)))


def start(*words: str) -> None:
    """Run the command line, or a process by name with it; an error is one line, and exit status 1."""
    try:
        main([*words, *sys.argv[1:]], prog_name="python -P -m catstream.processes")
    except CatstreamError as error:
        sys.exit(f"catstream: {error}")


if __name__ == "__main__":
    start()

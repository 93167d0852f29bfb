"""`python -P -m catstream.services NAME`: THE LIST of processes, a command each.

Each process can be started by hand, in any order; `catstream track` starts them all. What a process works on is its
`catstream.job.Job`: the options of a command build one, and a parent process gives its children the file of one.
"""

from __future__ import annotations

from catstream.threads import limit_process

limit_process()  # before anything imports numpy

import logging
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import click

from catstream.errors import CatstreamError
from catstream.job import Job
from catstream.services.loop import Parent, run
from catstream.services.options import with_model, with_object, with_part, with_settings

_PATH = click.Path(path_type=Path)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
def main() -> None:
    """The processes of a catstream pipeline.

    They meet at an endpoint: a folder that holds their sockets, or tcp://127.0.0.1:PORT. All need
    the same settings. With -P, no file in the current folder is imported.

    \b
      mkdir -m 700 run
      python -P -m catstream.services compressor --set run.endpoint=run &
      python -P -m catstream.services trainer    --set run.endpoint=run &
      python -P -m catstream.services detector   --set run.endpoint=run walk.mp4 --box 120,80,64,48
    """


_source = click.argument("source")
_state = click.option("--state", type=_PATH, help="Folder of the checkpoints and of what was commanded.")
_record = click.option("--record", type=_PATH, help="File that the compressor records to; it goes on with one.")


@main.command()
@_source
@click.option("--resume", is_flag=True, help="Go on where a detector before this one stopped.")
@click.option("--owned", is_flag=True, help="Another process receives every track from the channel `results`.")
@_record
@_state
@with_object
@with_part
@with_settings
def detector(**options: Any) -> None:
    """Frames in; tracks and features out, with the newest model.

    With --record it waits until the compressor listens to the tracks.
    """
    _run("detector", Job(**options))


@main.command()
@_state
@_record
@with_model
@with_settings
def compressor(**options: Any) -> None:
    """Features in, samples out; owns the coreset trees."""
    _run("compressor", Job(**options))


@main.command()
@with_settings
def trainer(**options: Any) -> None:
    """Samples in, models out."""
    _run("trainer", Job(**options))


@main.command()
@_source
@with_object
@with_part
@with_settings
def supervisor(**options: Any) -> None:
    """Start the other three on a source, and keep them running."""
    from catstream.services import supervisor

    _log_as("supervisor")
    sys.exit(supervisor.main(Job(**options)))


@main.command(hidden=True)
@click.argument("name", type=click.Choice(["detector", "compressor", "trainer"]))
@click.argument("file", type=_PATH)
@click.option("--parent", type=int, required=True, help="Process id of the parent, with which the process ends.")
@click.option("--watchdog", type=int, help="File descriptor of the memory that the parent watches.")
@click.option("--restarted", is_flag=True, help="Go on where the process before this one stopped.")
def child(name: str, file: Path, parent: int, watchdog: int | None, restarted: bool) -> None:
    """Run one process of the job in a file."""
    job = Job.load(file)
    _run(name, replace(job, resume=job.resume or restarted), Parent(parent, watchdog))


def _run(name: str, job: Job, parent: Parent | None = None) -> NoReturn:
    """Run one of the three processes, and exit with its code."""
    _log_as(name)
    if name == "detector":
        import cv2

        cv2.setNumThreads(1)
    service = import_module(f"catstream.services.{name}")
    sys.exit(run(name, service.main, job, parent))


def _log_as(name: str) -> None:
    """Begin each line of the log with the name of the process, by which the supervisor finds them."""
    logging.basicConfig(format=f"{name}: %(message)s", level=logging.INFO)


def start() -> None:
    """Run the command line; an error is one line, and exit code 1."""
    try:
        main(prog_name="python -P -m catstream.services")
    except CatstreamError as error:
        sys.exit(f"catstream: {error}")


if __name__ == "__main__":
    start()

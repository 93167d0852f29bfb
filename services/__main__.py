"""`python -P -m catstream.services NAME`: THE LIST of processes, a command each.

Each can be started by hand, in any order, on any endpoint; `catstream track` starts them all.
"""

from __future__ import annotations

from catstream.threads import limit_process

limit_process()  # before anything imports numpy

import logging
import sys
from functools import partial
from pathlib import Path
from typing import Any

import click

from catstream.errors import CatstreamError
from catstream.services.loop import Parent, run
from catstream.services.options import with_model, with_object, with_part, with_settings
from catstream.settings import Settings


@click.group(context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.option("--parent", type=int, hidden=True, help="Process id of the one to end with.")
@click.option("--watchdog", type=int, hidden=True, help="File descriptor of the watchdog that it watches.")
@click.pass_context
def main(context: click.Context, parent: int | None, watchdog: int | None) -> None:
    """The processes of a catstream pipeline.

    They meet at an endpoint: a folder that holds their sockets, or tcp://127.0.0.1:PORT. All need
    the same settings. With -P, no file in the current folder is imported.

    \b
      mkdir -m 700 run
      python -P -m catstream.services compressor --set run.endpoint=run &
      python -P -m catstream.services trainer    --set run.endpoint=run &
      python -P -m catstream.services detector   --set run.endpoint=run walk.mp4 --box 120,80,64,48
    """
    logging.basicConfig(format=f"{context.invoked_subcommand}: %(message)s", level=logging.INFO)
    context.obj = None if parent is None else Parent(parent, watchdog)


_source = click.argument("source")


@main.command()
@_source
@click.option("--resume", is_flag=True, help="Go on where a detector before this one stopped.")
@click.option("--owned", is_flag=True, help="Somebody takes every track from the channel `results`.")
@click.option("--recorded", is_flag=True, help="Begin once somebody listens to the tracks: the compressor records.")
@click.option("--state", type=click.Path(path_type=Path), help="Folder to keep in what was commanded.")
@click.option("--since", type=float, hidden=True, help="Moment that the times of a live source count from.")
@with_object
@with_part
@with_settings
@click.pass_obj
def detector(parent: Parent | None, settings: Settings, **options: Any) -> None:
    """Frames in; tracks and features out, with the newest model there is."""
    import cv2

    from catstream.services import detector

    cv2.setNumThreads(1)
    sys.exit(run("detector", partial(detector.main, **options), settings, parent))


@main.command()
@click.option("--state", type=click.Path(path_type=Path), help="Folder of the checkpoint to go on from.")
@click.option("--record", type=click.Path(path_type=Path), help="File to write all that travels to, or to go on with.")
@with_model
@with_settings
@click.pass_obj
def compressor(parent: Parent | None, settings: Settings, **options: Any) -> None:
    """Features in, samples out; owns the coreset trees."""
    from catstream.services import compressor

    sys.exit(run("compressor", partial(compressor.main, **options), settings, parent))


@main.command()
@with_settings
@click.pass_obj
def trainer(parent: Parent | None, settings: Settings) -> None:
    """Samples in, models out."""
    from catstream.services import trainer

    sys.exit(run("trainer", trainer.main, settings, parent))


@main.command()
@_source
@with_object
@with_part
@with_settings
def supervisor(settings: Settings, source: str, **options: Any) -> None:
    """Start the other three on a source, and keep them running."""
    from catstream.services import supervisor

    sys.exit(supervisor.main(source, settings, **options))


def start() -> None:
    """Be the process that the command line asks for; one line for an error."""
    try:
        main(prog_name="python -P -m catstream.services")
    except CatstreamError as error:
        sys.exit(f"catstream: {error}")


if __name__ == "__main__":
    start()

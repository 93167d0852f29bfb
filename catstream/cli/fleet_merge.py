"""`catstream fleet merge`: one saved model from what several streams of a fleet have learned of an object."""

from __future__ import annotations

from pathlib import Path

import click

from catstream.cli.fleet import with_fleet
from catstream.errors import ServiceError
from catstream.messages import storage
from catstream.messages.names import UNNAMED

__all__ = ["merge"]


@click.command()
@click.argument("names", nargs=-1)
@click.option(
    "--object", "object_name", default=UNNAMED, metavar="NAME", help="Name of the object; default: the only one."
)
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="Write the model to a file, too.")
@with_fleet
def merge(names: tuple[str, ...], object_name: str, output: Path | None, of: dict[str, object]) -> None:
    """Merge what the streams NAMES have learned of an object; default: all.

    The model is kept in the store of the fleet, and each stream that follows
    the object searches for it by this model. A state in the store is a few
    seconds old. Frames that several states contain are counted once.

    \b
    EXAMPLES
      catstream fleet merge --object anna
      catstream fleet merge cam-1 cam-2 --object anna -o anna.safetensors
    """
    from catstream.fleet.fleet import Fleet

    with Fleet(**of) as running:  # type: ignore[arg-type]
        merged = running.merge(*names, object=object_name)
    if output is not None:
        try:
            storage.write_atomically(output, merged.model)
        except OSError as error:
            raise ServiceError(f"cannot write {str(output)!r} ({error.strerror}): give another file") from None
    line = f"merged: {', '.join(merged.streams)}"
    if merged.skipped:
        line += f"; the frames of these are in them already, at least in part: {', '.join(merged.skipped)}"
    click.echo(line)

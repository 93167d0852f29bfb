"""`catstream merge`: one saved model from several of the same object."""

from __future__ import annotations

import warnings
from pathlib import Path

import click

from catstream.cli.files import check_file
from catstream.cli.output import complain
from catstream.run.learned import Learned
from catstream.run.learned import merge as merged
from catstream.services.options import PATH, with_overwrite


@click.command()
@click.argument("files", nargs=-1, required=True, type=PATH, metavar="FILE...")
@click.option("-o", "--output", required=True, type=PATH, metavar="FILE", help="File to write.")
@with_overwrite
@click.option("--force", is_flag=True, help="Merge models although their objects look different.")
def merge(files: tuple[Path, ...], output: Path, overwrite: bool, force: bool) -> None:
    """Merge saved models of one object, for example from two cameras.

    The coreset trees of all files are merged, and a model is trained from them.
    Its scores are those of one tree that has seen all the videos, within the
    bound of the coreset. The files must be of the same object and settings, and
    no two of them may contain the same frames. Models that look like those of
    different objects are rejected; in case of doubt there is a warning.

    \b
    EXAMPLES
      catstream merge door.safetensors yard.safetensors -o anna.safetensors
    """
    check_file(output, overwrite=overwrite)
    parts = [Learned.load(file) for file in files]
    with warnings.catch_warnings(record=True, action="always", category=UserWarning) as doubts:
        whole = merged(parts, force=force)
    for doubt in doubts:
        complain(f"warning: {doubt.message}")
    whole.save(output)
    tree = whole.trees["object"]
    click.echo(
        f"{output}: {len(files)} saved models, {len(whole.origins)} videos, {tree.rows_seen} rows of the object in "
        f"{len(tree.nodes)} nodes"
    )

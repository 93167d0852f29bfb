"""`catstream network`: make the file of a network whose features are used beside HOG and colours, and measure it."""

from __future__ import annotations

from pathlib import Path

import click

from catstream.base.files import check_file
from catstream.cli.common import INTERRUPTS, CommandGroup
from catstream.cli.options import PATH, with_overwrite
from catstream.errors import require_extra

_Levels = tuple[float, float, float]


@click.group(cls=CommandGroup)
def network() -> None:
    """Use the features of a small network beside HOG and colours.

    \b
    EXAMPLES
      catstream network prepare backbone.onnx --layer output --images photos/ -o net.onnx
      catstream network check net.onnx
      catstream track walk.mp4 --box 120,80,64,48 --set features.network=net.onnx
    """


@network.command()
@click.argument("backbone", type=PATH, metavar="BACKBONE.onnx")
@click.option("--layer", required=True, metavar="NAME", help="Layer with a vector for each 16 x 16 pixels.")
@click.option("--images", required=True, type=PATH, metavar="FOLDER", help="Photographs, a hundred or more.")
@click.option("-o", "--output", required=True, type=PATH, metavar="FILE.onnx", help="File to write.")
@click.option("--rgb", is_flag=True, help="The backbone takes red, green, blue; not blue, green, red.")
@click.option("--mean", nargs=3, type=float, default=(0, 0, 0), help="Subtracted from its channels, of 0 to 255.")
@click.option("--std", nargs=3, type=float, default=(1, 1, 1), help="By what the rest is divided.")
@with_overwrite
def prepare(
    backbone: Path, layer: str, images: Path, output: Path, rgb: bool, mean: _Levels, std: _Levels, overwrite: bool
) -> None:
    """Make the file for the setting features.network from a backbone.

    The backbone is an ONNX file whose input is an image. It is cut at the layer,
    takes images of any size, and normalises them itself. Its vectors are reduced
    to at most 32 principal components, those of the photographs in FOLDER and its
    subfolders, which should show what will be tracked.

    \b
    EXAMPLES
      catstream network prepare backbone.onnx --layer output --images photos/ -o net.onnx
      catstream network prepare mobilenet.onnx --layer block14 --images photos/ -o net.onnx \\
        --rgb --mean 123.675 116.28 103.53 --std 58.395 57.12 57.375
    """
    require_extra("network")
    with INTERRUPTS.leaving():
        from catstream import backbone as backbones

    check_file(output, overwrite=overwrite)
    backbones.prepare(backbone, layer, images, output, rgb=rgb, mean=mean, std=std)
    _print(output)


@network.command()
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path), metavar="FILE.onnx")
def check(file: Path) -> None:
    """Measure a file for the setting features.network.

    Prints its cost, the variance of the backbone that is kept, and the
    correlation of its vectors with those sampled from a run beside them. Near 1,
    all windows of a frame can be sampled from one run, as tracking does.
    """
    _print(file)


def _print(file: Path) -> None:
    with INTERRUPTS.leaving():
        from catstream import backbone as backbones

    found = backbones.check(file)
    click.echo(f"{file}: {found.network.channels} channels, digest {found.network.digest}")
    if found.kept:
        click.echo(f"kept variance {found.kept:.0%}")
    click.echo(f"{found.seconds * 1e3:.1f} ms for the surroundings of an object, twice a frame")
    click.echo(f"correlation {found.agreement:.2f} with vectors that are sampled from a run 8 pixels beside")

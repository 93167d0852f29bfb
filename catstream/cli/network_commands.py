"""`catstream network`: prepare and check a network whose features are added to HOG and colours."""

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
    """Add the features of a small neural network to HOG and colours.

    \b
    EXAMPLES
      catstream network prepare backbone.onnx --layer output --images photos/ -o net.onnx
      catstream network check net.onnx
      catstream track walk.mp4 --box 120,80,64,48 --set features.network=net.onnx
    """


@network.command()
@click.argument("backbone", type=PATH, metavar="BACKBONE.onnx")
@click.option("--layer", required=True, metavar="NAME", help="Layer with stride 16 whose output is used.")
@click.option("--images", required=True, type=PATH, metavar="FOLDER", help="Folder of photographs for the PCA.")
@click.option("-o", "--output", required=True, type=PATH, metavar="FILE.onnx", help="Output file.")
@click.option("--rgb", is_flag=True, help="The backbone expects RGB input (default: BGR).")
@click.option("--mean", nargs=3, type=float, default=(0, 0, 0), help="Per-channel mean (0-255 scale).")
@click.option("--std", nargs=3, type=float, default=(1, 1, 1), help="Per-channel standard deviation (0-255 scale).")
@with_overwrite
def prepare(
    backbone: Path, layer: str, images: Path, output: Path, rgb: bool, mean: _Levels, std: _Levels, overwrite: bool
) -> None:
    """Prepare a backbone for the setting features.network.

    The backbone is an ONNX file with an image as its input. It is truncated at
    the layer; the input size becomes dynamic, and the normalisation a part of the
    graph. The vectors are reduced to at most 32 principal components of the
    photographs in FOLDER, which should resemble the videos to track.

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
    """Check a file for the setting features.network.

    Prints the time of one inference, the explained variance of the PCA, and the
    translation equivariance: the correlation of the vectors of a shifted image
    with those interpolated from the original one. Near 1, all windows of a frame
    can be interpolated from one inference, as tracking does.
    """
    _print(file)


def _print(file: Path) -> None:
    with INTERRUPTS.leaving():
        from catstream import backbone as backbones

    measured = backbones.check(file)
    click.echo(f"{file}: {measured.network.channels} channels, digest {measured.network.digest}")
    if measured.explained:
        click.echo(f"explained variance {measured.explained:.0%}")
    click.echo(f"{measured.seconds * 1e3:.1f} ms for each inference, at most two a frame")
    click.echo(f"equivariance {measured.equivariance:.2f} (correlation after a shift of 8 pixels)")

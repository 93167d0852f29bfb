"""`catstream network`: make the file of a network whose features are used beside HOG and colours, and measure it."""

from __future__ import annotations

from pathlib import Path

import click

from catstream.cli.common import INTERRUPTS, check_file
from catstream.errors import require_extra
from catstream.services.options import PATH, with_overwrite


def _levels(_: click.Context, __: click.Parameter, text: str) -> tuple[float, ...]:
    try:
        one, two, three = map(float, text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not three numbers: for example 123.7,116.3,103.5") from None
    return one, two, three


@click.group()
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
@click.option(
    "--mean", default="0,0,0", callback=_levels, metavar="A,B,C", help="Subtracted from its channels, 0 to 255."
)
@click.option("--std", default="1,1,1", callback=_levels, metavar="A,B,C", help="By what the rest is divided.")
@with_overwrite
def prepare(
    backbone: Path,
    layer: str,
    images: Path,
    output: Path,
    rgb: bool,
    mean: tuple[float, ...],
    std: tuple[float, ...],
    overwrite: bool,
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
        --rgb --mean 123.675,116.28,103.53 --std 58.395,57.12,57.375
    """
    require_extra("network")
    with INTERRUPTS.leaving():
        from catstream.applications.backbone import prepare as prepared

    check_file(output, overwrite=overwrite)
    prepared(backbone, layer, images, output, rgb=rgb, mean=mean, std=std)
    _print(output)


@network.command()
@click.argument("file", type=PATH, metavar="FILE.onnx")
def check(file: Path) -> None:
    """Measure a file for the setting features.network.

    Prints what it costs in a frame, how much of the variance of the backbone is
    kept, and whether its vectors move with the picture: near 1, all windows of a
    frame can be sampled from one run, as tracking does. Squeeze-and-excitation
    and large strides lower it.
    """
    _print(file)


def _print(file: Path) -> None:
    with INTERRUPTS.leaving():
        from catstream.applications.backbone import check as measured

    found = measured(file)
    click.echo(f"{file}: {found.channels} channels, digest {found.digest}")
    if found.kept is not None:
        click.echo(f"kept variance {found.kept:.0%}")
    click.echo(f"a frame takes {found.region * 1e3:.1f} ms for the search region, {found.copy * 1e3:.1f} ms for a copy")
    for shift, agreement in found.agreement.items():
        click.echo(
            f"after a shift of {shift} pixels, vectors correlate by {agreement:.2f} with those sampled before it"
        )

"""Prepares a backbone for `features.network`, and checks the result.

The backbone is truncated at a layer of stride 16. The preprocessing of its training is prepended, and a 1 x 1
convolution appended that projects its vectors to their principal components in photographs, centred and scaled.
"""

from __future__ import annotations

import difflib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from catstream.base.box import Window
from catstream.base.files import write_atomically, writing
from catstream.base.text import cause_of
from catstream.errors import SettingsError, VideoError, require_extra
from catstream.features.layout import CELL, EDGE, STRIDE, WINDOW
from catstream.features.network import ENERGY, MAX_CHANNELS, Network, by_onnxruntime
from catstream.features.pyramid import Pyramid
from catstream.features.vectors import VectorMap
from catstream.video.images import IMAGES, ImageReader, natural_order, pages_of
from catstream.video.rendered import render

if TYPE_CHECKING:
    import onnx

_CROP = 224  # side of a crop of a photograph, in pixels
_CROPS = 256  # of all photographs together
_SMALLEST = 64  # side of the part of a photograph that becomes a crop, at least
_INNER = slice(EDGE * CELL // STRIDE, -EDGE * CELL // STRIDE)  # vectors that hardly depend on the edge of a crop
_EXPLAINED = "catstream.explained_variance"  # in the metadata of the file


def prepare(
    backbone: str | os.PathLike[str],
    layer: str,
    images: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    rgb: bool = False,
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0),
    std: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> None:
    """Write the file of a network for `features.network`, from a layer of a backbone and a folder of photographs.

    The layer is the name of a tensor, or of the node that makes it. The backbone takes red, green and blue if `rgb`;
    `mean` is subtracted from their levels, 0 to 255, and the rest is divided by `std`. SettingsError if the backbone is
    no ONNX file, has no such layer, or the layer another stride; VideoError if there are no photographs.
    """
    require_extra("network")
    import onnx

    try:
        model = onnx.shape_inference.infer_shapes(onnx.load(os.fspath(backbone)))
    except Exception as error:  # of the file, of protobuf, or of ONNX
        raise SettingsError(
            f"cannot read the backbone {str(backbone)!r} ({cause_of(error)}): pass an ONNX file"
        ) from None
    crops = list(_crops(Path(images)))
    model = _truncated(model, layer, str(backbone))
    _prepend(model, rgb, np.array(mean), np.array(std))
    run = by_onnxruntime(Path(backbone), model.SerializeToString())
    vectors = np.concatenate([_inner_vectors(run, crop, layer) for crop in crops])
    centre = vectors.mean(axis=0)
    variances, directions = np.linalg.eigh((vectors - centre).T @ (vectors - centre) / len(vectors))
    explained = variances[-MAX_CHANNELS:].sum()
    basis = directions[:, -MAX_CHANNELS:].T[::-1] * np.sqrt(ENERGY / explained)
    _append(model, basis, -basis @ centre)
    onnx.helper.set_model_props(model, {_EXPLAINED: f"{explained / variances.sum():.4f}"})
    with writing(output):
        write_atomically(output, model.SerializeToString())


def _crops(folder: Path) -> Iterator[np.ndarray]:
    """Squares of all sizes from all photographs below a folder, uint8 (3, 224, 224)."""
    files = sorted((file for file in folder.rglob("*") if file.suffix.lower() in IMAGES), key=natural_order)
    chosen = [files[i] for i in np.linspace(0, len(files) - 1, min(len(files), _CROPS)).astype(int)]
    images = [image for file in chosen if (image := ImageReader(pages_of(file) or [(file, 0)])(0)) is not None]
    if not images:
        raise VideoError(
            f"the folder {str(folder)!r} and its subfolders contain no images: pass a folder of photographs"
        )
    rng = np.random.default_rng(0)
    for number in range(_CROPS):
        frame = Pyramid(images[number % len(images)])
        most = max(*frame.size, _SMALLEST) if min(frame.size) < _SMALLEST else min(frame.size)
        side = _SMALLEST * (most / _SMALLEST) ** rng.uniform()
        x, y = (side / 2 + rng.uniform() * max(length - side, 0) for length in frame.size)
        yield frame.cut(x, y, side / _CROP, side / _CROP, _CROP)


def _truncated(model: onnx.ModelProto, layer: str, name: str) -> onnx.ModelProto:
    """The part of a model from its image to a layer, for images of any height and width."""
    import onnx

    weights = {tensor.name for tensor in model.graph.initializer}
    inputs = [tensor.name for tensor in model.graph.input if tensor.name not in weights]
    if len(inputs) != 1:
        raise SettingsError(f"the backbone {name!r} has the inputs {', '.join(inputs)}, expected one image")
    outputs = {tensor: tensor for node in model.graph.node for tensor in node.output}
    tensors = {node.name: node.output[0] for node in model.graph.node} | outputs
    if layer not in tensors:
        near = difflib.get_close_matches(layer, tensors, n=3, cutoff=0.0)
        raise SettingsError(f"the backbone {name!r} has no layer {layer!r}: the nearest names are {', '.join(near)}")
    part = onnx.utils.Extractor(model).extract_model(inputs, [tensors[layer]])
    del part.graph.value_info[:]  # the sizes of one image
    for tensor in (*part.graph.input, *part.graph.output):
        for side in list(tensor.type.tensor_type.shape.dim)[2:]:
            side.Clear()
    return part


def _prepend(model: onnx.ModelProto, rgb: bool, mean: np.ndarray, std: np.ndarray) -> None:
    """Add what orders and normalises the channels of the pixels; a convolution of three channels would be slow."""
    (image,) = model.graph.input
    steps: list[tuple[bool, str, np.ndarray, dict[str, Any]]] = [
        (bool((std != 1).any()), "Div", std.astype(np.float32)[:, None, None], {}),
        (bool(mean.any()), "Sub", mean.astype(np.float32)[:, None, None], {}),
        (rgb, "Gather", np.array([2, 1, 0]), {"axis": 1}),
    ]
    for used, operation, values, how in steps:
        if used:
            node = _node(model, operation, f"{operation} {image.name}", image.name, values, **how)
            model.graph.node.insert(0, node)
            image.name = node.input[0]


def _append(model: onnx.ModelProto, weights: np.ndarray, bias: np.ndarray) -> None:
    """Add a 1 x 1 convolution of the vectors."""
    (vectors,) = model.graph.output
    parts = weights.astype(np.float32)[:, :, None, None], bias.astype(np.float32)
    model.graph.node.append(_node(model, "Conv", vectors.name, "vectors", *parts))
    vectors.name = "vectors"
    vectors.type.tensor_type.shape.dim[1].dim_value = len(weights)


def _node(
    model: onnx.ModelProto, operation: str, source: str, target: str, *constants: np.ndarray, **how: Any
) -> onnx.NodeProto:
    """A node from one tensor to another, whose constants are added to the model."""
    import onnx

    names = [f"{target}, constant {number}" for number in range(len(constants))]
    model.graph.initializer.extend(map(onnx.numpy_helper.from_array, constants, names))
    return onnx.helper.make_node(operation, [source, *names], [target], name=target, **how)


def _inner_vectors(run: Callable[[np.ndarray], np.ndarray], planes: np.ndarray, layer: str) -> np.ndarray:
    """The vectors of a crop, float64 (k, channels); SettingsError if the layer has another stride than 16."""
    vectors, side = run(planes[None].astype(np.float32)), _CROP // STRIDE
    if vectors.shape != (1, vectors.shape[1], side, side):
        raise SettingsError(
            f"the layer {layer!r} is {vectors.shape} for an image of {_CROP} x {_CROP}, expected (1, any, {side}, "
            f"{side}): choose a layer of stride {STRIDE}"
        )
    return vectors[0, :, _INNER, _INNER].reshape(vectors.shape[1], -1).T.astype(np.float64)


@dataclass(frozen=True, slots=True)
class Check:
    """The cost and the quality of a network.

    network       the network
    explained     explained variance of the principal components, from 0 to 1; 0 if the file does not contain it
    seconds       time of one inference on 224 x 224 pixels, the surroundings of an object
    equivariance  correlation of the vectors of a shifted image with those interpolated from the original one
    """

    network: Network
    explained: float
    seconds: float
    equivariance: float


def check(path: str | os.PathLike[str]) -> Check:
    """Measure the cost and the quality of a network; raises the errors of `Network`."""
    require_extra("network")
    import onnx

    network = Network(Path(path))
    metadata = {entry.key: entry.value for entry in onnx.load(os.fspath(path)).metadata_props}
    explained = metadata.get(_EXPLAINED, "0")
    ((image, _),) = render(1)
    frame, side = Pyramid(image), _CROP // CELL - 2 * EDGE
    window = Window(0.0, 0.0, WINDOW * CELL, WINDOW * CELL).centred(image.shape[1] / 2, image.shape[0] / 2)
    moved = window.centred(window.centre[0] + CELL, window.centre[1] + CELL)  # half of the way to the next vector
    before, after = (VectorMap.of(network, frame.around(at, side, EDGE), at) for at in (window, moved))
    sampled, own = before.grid(moved, WINDOW).ravel(), after.grid(moved, WINDOW).ravel()
    times = []
    for _ in range(20):
        start = time.perf_counter()
        network(frame.around(window, side, EDGE))
        times.append(time.perf_counter() - start)
    return Check(
        network, float(explained), min(times), float(sampled @ own / np.sqrt((sampled @ sampled) * (own @ own)))
    )

"""Tiny networks in ONNX files, made here: nothing is downloaded."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from catstream.backbone import prepare


def write_network(folder, images):
    """A backbone with layers of stride 4 and 16, and what is prepared from it with the images of a folder."""
    write_backbone(folder / "backbone.onnx")
    prepare(folder / "backbone.onnx", "sixteenth", images, folder / "net.onnx", rgb=True, mean=(120, 110, 100))


def write_backbone(path):
    """Two convolutions of random weights, for images of 96 x 96 pixels."""
    rng = np.random.default_rng(5)
    weights = {"one": rng.normal(size=(6, 3, 5, 5)), "two": rng.normal(size=(40, 6, 5, 5))}
    strided = {"strides": [4, 4], "pads": [2, 2, 2, 2]}
    nodes = [
        helper.make_node("Conv", ["picture", "one"], ["quarter"], "first", **strided),
        helper.make_node("Relu", ["quarter"], ["positive"]),
        helper.make_node("Conv", ["positive", "two"], ["sixteenth"], "second", **strided),
    ]
    save(path, nodes, [1, 3, 96, 96], [1, 40, 6, 6], weights)


def save(path, nodes, shape, found, weights, source="picture"):
    """An ONNX file of nodes, with one input, and the output of the last node."""
    image, output = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, sides)
        for name, sides in ((source, shape), (nodes[-1].output[0], found))
    )
    tensors = [numpy_helper.from_array(array.astype(np.float32), name) for name, array in weights.items()]
    graph = helper.make_graph(nodes, "tiny", [image], [output], tensors)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)

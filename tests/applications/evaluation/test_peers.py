"""OpenCV's trackers: boxes that they accept, and model files that they need.

In place of the trained networks, which are not included, the tests write small ones with the same inputs and outputs:
they find the mean colour of the object. An ONNX file is a message of protocol buffers, whose fields are in
https://github.com/onnx/onnx/blob/main/onnx/onnx.proto.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from catstream.applications.evaluation.onepass import evaluate, follow
from catstream.applications.evaluation.peers import MODELS, PEERS, Peer
from catstream.errors import BoxError, SettingsError
from catstream.settings import Settings

_FLOAT, _INT, _INTS = 1, 2, 7  # types of elements and attributes


def field(number: int, value: int | bytes | str) -> bytes:
    """A field of a message."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def varint(value: int) -> bytes:
    low, high = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + varint(high) if high else bytes([low])


def node(operator: str, inputs: str, output: str, **attributes: int | list[int]) -> bytes:
    """One operation of a network; `inputs` are separated by blanks."""
    message = b"".join(field(1, name) for name in inputs.split()) + field(2, output) + field(4, operator)
    for name, value in attributes.items():
        if isinstance(value, int):
            message += field(5, field(1, name) + field(3, value) + field(20, _INT))
        else:
            message += field(5, field(1, name) + b"".join(field(8, each) for each in value) + field(20, _INTS))
    return message


def tensor(name: str, values: np.ndarray) -> bytes:
    dimensions = b"".join(field(1, size) for size in values.shape)
    return dimensions + field(2, _FLOAT) + field(8, name) + field(9, values.astype("<f4").tobytes())


def value(name: str, shape: tuple[int, ...]) -> bytes:
    """An input or an output of a network."""
    dimensions = b"".join(field(1, field(1, size)) for size in shape)
    return field(1, name) + field(2, field(1, field(1, _FLOAT) + field(2, dimensions)))


def write(
    file: Path,
    nodes: list[bytes],
    weights: dict[str, np.ndarray],
    inputs: dict[str, tuple[int, ...]],
    outputs: dict[str, tuple[int, ...]],
) -> None:
    graph = b"".join(field(1, each) for each in nodes) + field(2, "network")
    graph += b"".join(field(5, tensor(name, values)) for name, values in weights.items())
    graph += b"".join(field(11, value(name, shape)) for name, shape in inputs.items())
    graph += b"".join(field(12, value(name, shape)) for name, shape in outputs.items())
    file.write_bytes(field(1, 7) + field(7, graph) + field(8, field(1, "") + field(2, 13)))


def distance_from_middle(template: str, side: int, cells: str) -> list[bytes]:
    """Compare the colour of each cell with the mean over the middle part of the template: the result is `squared`.

    side : pixels of each of the nine parts of the template, between which one pixel is left out
    """
    return [
        node("AveragePool", template, "nine", kernel_shape=[side, side], strides=[side + 1, side + 1]),
        node("Conv", "nine middle", "colour", kernel_shape=[3, 3], group=3),
        node("Sub", f"{cells} colour", "apart"),
        node("Mul", "apart apart", "squared"),
    ]


def convolved(weights: str, output: str) -> bytes:
    return node("Conv", f"squared {weights}", output, kernel_shape=[1, 1])


MIDDLE = np.zeros((3, 1, 3, 3))
MIDDLE[:, :, 1, 1] = 1


def write_nano(folder: Path) -> None:
    """Write a backbone, which has the mean colour of each cell, and a head, which compares it with the object's."""
    backbone, head = (folder / name for name in MODELS["nano"].values())
    pool = node("AveragePool", "image", "cells", kernel_shape=[16, 16], strides=[16, 16], pads=[0, 0, 1, 1])
    write(backbone, [pool], {}, {"image": (1, 3, 255, 255)}, {"cells": (1, 3, 16, 16)})
    weights = {
        "middle": MIDDLE,
        "contrast": np.array([[0.001] * 3, [-0.001] * 3]).reshape(2, 3, 1, 1),
        "none": np.zeros((4, 3, 1, 1)),
        "edges": np.full(4, 127 / 4),  # from the centre of a square object, in pixels of the crop
    }
    write(
        head,
        [
            *distance_from_middle("input1", 2, "input2"),
            convolved("contrast", "output1"),
            convolved("none edges", "output2"),
        ],
        weights,
        {"input1": (1, 3, 8, 8), "input2": (1, 3, 16, 16)},
        {"output1": (1, 2, 16, 16), "output2": (1, 4, 16, 16)},
    )


def write_vit(folder: Path) -> None:
    """Write a network whose score falls with the distance of the mean colour of a cell from that of the object."""
    (file,) = (folder / name for name in MODELS["vit"].values())
    weights = {
        "middle": MIDDLE,
        "contrast": np.full((1, 3, 1, 1), -0.2),
        "best": np.ones(1),
        "none": np.zeros((2, 3, 1, 1)),
        "sides": np.full(2, 0.25),  # of the object, as parts of the search area
        "centres": np.full(2, 0.5),  # as parts of a cell
    }
    write(
        file,
        [
            node("AveragePool", "search", "cells", kernel_shape=[16, 16], strides=[16, 16]),
            *distance_from_middle("template", 42, "cells"),
            convolved("contrast best", "output1"),
            convolved("none sides", "output2"),
            convolved("none centres", "output3"),
        ],
        weights,
        {"template": (1, 3, 128, 128), "search": (1, 3, 256, 256)},
        {"output1": (1, 1, 16, 16), "output2": (1, 2, 16, 16), "output3": (1, 2, 16, 16)},
    )


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A folder with small networks in place of the trained ones."""
    folder = tmp_path_factory.mktemp("models")
    write_nano(folder)
    write_vit(folder)
    return folder


@pytest.mark.parametrize("tracker", MODELS)
def test_a_tracker_with_model_files_runs_and_reports_its_confidence(tracker, models, sequence, capfd):
    run = follow(tracker, Settings(), sequence, peer_models=models)
    assert run.score().auc > 0.4
    assert ((run.confidence[1:] > 0.2) & (run.confidence[1:] < 1)).all()
    assert capfd.readouterr().err == ""


def test_a_tracker_without_its_model_files_is_an_error_that_names_them_before_the_first_run(tmp_path, sequence):
    with pytest.raises(SettingsError, match=r"needs object_tracking_vittrack_2023sep.onnx: .* --peer-models"):
        evaluate([sequence], ["mil", "vit"], Settings())
    (tmp_path / "nanotrack_backbone_sim.onnx").touch()
    with pytest.raises(SettingsError, match=r"has no nanotrack_head_sim.onnx: put it there"):
        evaluate([sequence], ["nano"], Settings(), peer_models=tmp_path)


def test_a_model_file_that_opencv_cannot_read_is_one_line_of_error(tmp_path, capfd):
    (tmp_path / "object_tracking_vittrack_2023sep.onnx").write_text("not a network")
    with pytest.raises(SettingsError, match=r"cannot read the model files of the tracker 'vit' .*: download") as caught:
        Peer("vit", tmp_path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_a_box_across_the_edge_of_the_frame_is_clipped_for_opencv(sequence):
    frame = next(iter(sequence.frames()))
    peer = Peer("mil")
    peer.init(frame, (-8.0, 90.0, 40.0, 40.0))
    found, _ = peer.update(frame)
    assert found
    assert peer.score == 1


def test_a_box_outside_the_frame_is_one_line_of_error(sequence):
    with pytest.raises(BoxError, match="outside the frame of 160 x 120"):
        Peer("mil").init(next(iter(sequence.frames())), (-90, 0, 60, 60))


def test_a_box_that_opencv_rejects_is_one_line_of_error(monkeypatch, sequence):
    class Broken:
        def init(self, *_):
            raise cv2.error("assertion failed")

    peer = Peer("mil")
    monkeypatch.setattr(peer, "_create", Broken)
    with pytest.raises(BoxError, match="does not accept the box 1,2,30,40"):
        peer.init(next(iter(sequence.frames())), (1, 2, 30, 40))


def test_a_tracker_missing_in_opencv_is_an_error_with_the_install_command(monkeypatch):
    monkeypatch.setitem(PEERS, "csrt", "TrackerThatIsNot")
    with pytest.raises(SettingsError, match=r"catstream\[peers\]"):
        Peer("csrt")

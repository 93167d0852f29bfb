"""`catstream network`: make a file from a backbone, measure it, and track with it."""

import shutil

import pytest

from tests.networks import write_backbone


def test_a_prepared_backbone_is_measured_and_tracks(said, walk, tmp_path):
    write_backbone(tmp_path / "backbone.onnx")
    words = ("network", "prepare", tmp_path / "backbone.onnx", "--layer", "second", "--images", walk)
    code, output, errors = said(*words, "-o", tmp_path / "net.onnx")
    assert (code, errors) == (0, "")
    assert "32 channels" in output
    assert said(*words, "-o", tmp_path / "net.onnx")[2].count("exists already") == 1
    code, measured, _ = said("network", "check", tmp_path / "net.onnx")
    assert (code, measured.splitlines()[1]) == (0, output.splitlines()[1])
    assert "explained variance" in measured
    shutil.copytree(walk, tmp_path / "set" / "walk")
    network = f"features.network={tmp_path / 'net.onnx'}"
    code, output, errors = said("evaluate", tmp_path / "set", "--set", network, "--output", tmp_path / "results")
    assert (code, errors) == (0, "")


@pytest.mark.parametrize(
    ("layer", "images", "what"),
    [
        ("sixteen", "walk", "has no layer 'sixteen': the nearest names are sixteenth"),
        ("quarter", "walk", r"is (1, 6, 56, 56) for an image of 224 x 224, expected (1, any, 14, 14)"),
        ("sixteenth", "none", "contain no images"),
    ],
)
def test_a_layer_or_a_folder_that_does_not_do_is_one_line_of_error(said, walk, tmp_path, layer, images, what):
    write_backbone(tmp_path / "backbone.onnx")
    folder = walk if images == "walk" else tmp_path
    words = ("network", "prepare", tmp_path / "backbone.onnx", "--layer", layer, "--images", folder)
    code, _, errors = said(*words, "-o", tmp_path / "net.onnx")
    assert (code, errors.count("\n")) == (1, 1)
    assert what in errors
    assert not (tmp_path / "net.onnx").exists()


def test_only_a_file_that_exists_is_measured(fail, tmp_path):
    assert "does not exist" in fail("network", "check", tmp_path / "none.onnx")


def test_a_network_that_cannot_be_used_is_an_error_before_a_run(said, demo_video, tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"no network")
    path, boxes = demo_video(32)
    setting = f"features.network={tmp_path / 'net.onnx'}"
    code, _, errors = said("track", path, "--box", str(boxes[0]), "--set", setting, "--output", tmp_path / "out")
    assert (code, errors.count("\n")) == (1, 1)
    assert f"{str(tmp_path / 'net.onnx')!r} cannot be used" in errors

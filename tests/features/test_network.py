"""A network as a descriptor: the contract of its file, and the vectors that are sampled from one run."""

import sys

import numpy as np
import pytest
from onnx import helper

from catstream.base.box import Window
from catstream.base.settings import Settings
from catstream.errors import MissingExtraError, SettingsError
from catstream.features.cells import Cells
from catstream.features.descriptor import descriptor_of
from catstream.features.layout import EDGE, PLACES, WINDOW, row_length
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap
from catstream.features.vectors import VectorMap
from catstream.messages.kinds import Model
from tests.networks import save

OBJECT = Window(100.0, 60.0, 64.0, 64.0)


@pytest.fixture
def descriptor(network):
    return descriptor_of(Settings(features={"network": str(network / "net.onnx")}))


@pytest.fixture
def frame(texture, descriptor):
    return Pyramid(texture(240, 320, 24), descriptor)


def convolution(channels, stride, gain, height=None):
    """A file of one convolution with equal weights."""

    def write(path):
        node = helper.make_node("Conv", ["picture", "w"], ["out"], strides=[stride, stride])
        weights = np.full((channels, 3, stride, stride), gain / stride**2)
        save(path, [node], [1, 3, height, height], [1, channels, None, None], {"w": weights})

    return write


@pytest.mark.parametrize(
    ("write", "found"),
    [
        (lambda path: path.write_bytes(b"no network"), "onnxruntime cannot read it"),
        (convolution(8, 16, 0.001, height=64), r"it rejects a float32 \(1, 3, 224, 224\)"),
        (convolution(8, 8, 0.001), r"its output is float32 \(1, 8, 28, 28\), expected float32 \(1, 1 to 32, 14, 14\)"),
        (convolution(33, 16, 0.001), r"its output is float32 \(1, 33, 14, 14\)"),
        (convolution(8, 16, 1.0), r"the mean squared norm of its vectors is \S+, expected about 0.39"),
        (lambda _: None, "cannot read features.network=.* No such file"),
    ],
    ids=["no ONNX", "one size", "stride", "channels", "length", "none"],
)
def test_a_file_that_breaks_the_contract_is_refused_with_what_was_found(tmp_path, write, found):
    write(tmp_path / "net.onnx")
    with pytest.raises(SettingsError, match=found.replace("=.* ", r"=.*\(")) as error:
        descriptor_of(Settings(features={"network": str(tmp_path / "net.onnx")}))
    assert "\n" not in str(error.value)


def test_without_onnxruntime_opencv_computes_the_same_or_the_error_names_the_extra(
    network, image, monkeypatch, tmp_path
):
    from catstream.features import network as module

    planes = np.ascontiguousarray(image[:192, :224].transpose(2, 0, 1))
    expected = module.Network(network / "net.onnx")(planes)
    monkeypatch.setattr(module, "find_spec", lambda _: None)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    np.testing.assert_allclose(module.Network(network / "net.onnx")(planes), expected, atol=1e-4)
    (tmp_path / "other.onnx").write_bytes(b"no network")
    with pytest.raises(MissingExtraError, match=r'OpenCV cannot read .*"catstream\[network\]"'):
        module.Network(tmp_path / "other.onnx")


def test_vectors_are_centred_and_vary_as_much_as_four_cells(descriptor, walk):
    from catstream.backbone import _crops

    vectors = np.concatenate([descriptor(each)[2:-2, 2:-2].reshape(-1, 32) for each in _crops(walk)])
    assert vectors.shape[1] == descriptor.channels == 32
    assert np.abs(vectors.mean(axis=0)).max() < 1e-3
    assert (vectors**2).sum(axis=1).mean() == pytest.approx(0.39, rel=0.01)


def test_a_spline_reproduces_lines_wherever_and_however_rotated_it_is_evaluated():
    y, x = np.mgrid[:14.0, :14.0]
    vectors = VectorMap(np.stack([x, y, 1 + 0 * x], axis=-1).astype(np.float32), OBJECT)
    for window, turn in ((OBJECT, 0.0), (Window(97.0, 71.0, 72.0, 50.0), 0.3)):
        grid = vectors.grid(window, WINDOW, turn)
        assert grid.shape == (7, 7, 3)
        right = np.array([window.w * np.cos(turn), window.w * np.sin(turn)]) / 8
        below = np.array([-window.h * np.sin(turn), window.h * np.cos(turn)]) / 8
        middle = (np.array(window.centre) - OBJECT.centre) / 16 + 6.5
        for (row, column), vector in zip(np.ndindex(7, 7), grid.reshape(-1, 3), strict=True):
            place = middle + ((column - 3) * right + (row - 3) * below) / 16
            np.testing.assert_allclose(vector, [*place, 1], atol=1e-4)


def test_rows_end_with_the_vectors_of_the_window_and_scores_are_their_products(frame, rng):
    d = row_length(frame.descriptor.channels)
    model = Model(1, 0, rng.normal(size=d).astype(np.float32), 0.5)
    scores = ScoreMap.around(frame, OBJECT, 20, model)
    places = [(0, 0), (6, 6), (12, 3)]
    rows = scores.cells.rows(places)
    assert rows.shape == (3, d)
    for place, row in zip(places, rows, strict=True):
        window = scores.window(*place)
        np.testing.assert_allclose(row[row_length() :], scores.vectors.row(window), atol=1e-5)
        assert scores.scores[place] == pytest.approx(model.weights @ row + 0.5, abs=1e-3)
    plain = Cells.within(frame.around(OBJECT, 20)).row(6, 6)
    np.testing.assert_allclose(rows[1, : row_length()], plain, atol=1e-6)


def test_a_window_sampled_from_the_region_is_nearly_as_if_it_was_described_by_itself(frame):
    around = VectorMap.of(frame.descriptor, frame.around(OBJECT, 20, EDGE), OBJECT)
    for window in (OBJECT, OBJECT.centred(148.0, 100.0)):
        own = VectorMap.of(frame.descriptor, frame.around(window, WINDOW, EDGE), window).row(window)
        sampled = around.row(window)
        assert sampled.shape == (PLACES**2 * 32,)
        assert np.linalg.norm(own - sampled) < 0.2 * np.linalg.norm(own)


def test_windows_of_a_frame_described_at_once_are_nearly_those_described_alone(frame, rng):
    model = Model(1, 0, rng.normal(size=row_length(frame.descriptor.channels)).astype(np.float32), 0.5)
    scores = ScoreMap.within(frame, frame.region, OBJECT, model, described=True)
    for place in ((0, 0), (7, 11), *np.argwhere(scores.scores == scores.scores.min()).tolist()):
        row, own = scores.cells.row(*place), row_of(frame, scores.window(*place), model)
        assert scores.scores[tuple(place)] == pytest.approx(model.weights @ row + 0.5, abs=1e-3)
        assert np.linalg.norm(own - row) < 0.2 * np.linalg.norm(own)


def row_of(frame, window, model):
    """The row of a window that is described by itself."""
    return ScoreMap.around(frame, window, WINDOW, model).cells.row(0, 0)

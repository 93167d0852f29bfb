"""A small frozen network in an ONNX file as a descriptor.

The file has one input, float32 (1, 3, h, w), blue, green and red from 0 to 255, and one output, float32
(1, K, h / 16, w / 16), with K up to 32, for any h and w. `catstream network prepare` makes such a file.
"""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2b
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from catstream.base.threads import one_at_a_time
from catstream.errors import MissingExtraError, SettingsError, install_command
from catstream.features.layout import CELL, STRIDE

#: Mean square length of a vector: so much does the HOG of a cell vary.
ENERGY = 0.39
#: Channels of a vector at most.
MOST_CHANNELS = 32

_FACTOR = 16  # between the mean square length in the test image and `ENERGY`, at most
_TEST_SIZES = ((224, 224), (96, 160))  # of images, height and width

_Run = Callable[[np.ndarray], np.ndarray]


class Network:
    """A network of which each call is a function of its input; it runs on one thread.

    SettingsError if the file is none of the kind above; OSError if it cannot be read; MissingExtraError if neither
    onnxruntime is installed nor OpenCV reads the file.
    """

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        self.digest = blake2b(data, digest_size=8).hexdigest()
        self._run = by_onnxruntime(path, data) if find_spec("onnxruntime") else _by_opencv(path, data)
        self.channels = max(_checked(path, self._run, *size) for size in _TEST_SIZES)

    def __call__(self, planes: np.ndarray) -> np.ndarray:
        """Vectors of an image: see `catstream.features.descriptor.Descriptor`."""
        return np.ascontiguousarray(self._run(planes[None].astype(np.float32))[0].transpose(1, 2, 0))


def _checked(path: Path, run: _Run, height: int, width: int) -> int:
    """Number of channels; SettingsError unless the vectors of an image have the right shape, and about the length."""
    try:
        found = run(_test_image(height, width))
    except Exception as error:  # of onnxruntime or of OpenCV
        raise _misfit(path, f"it cannot take a float32 (1, 3, {height}, {width}) ({_first_line(error)})") from None
    channels, sides = found.shape[1] if found.ndim == 4 else 0, (height // STRIDE, width // STRIDE)
    if found.dtype != np.float32 or found.shape != (1, channels, *sides) or not 0 < channels <= MOST_CHANNELS:
        what = f"for an image of {height} x {width} its output is {found.dtype} {found.shape}, expected float32"
        raise _misfit(path, f"{what} (1, 1 to {MOST_CHANNELS}, {sides[0]}, {sides[1]})")
    length = float((found**2).sum(axis=1).mean())
    if not ENERGY / _FACTOR < length < ENERGY * _FACTOR:
        raise _misfit(path, f"the mean square length of its vectors is {length:.3g}, expected about {ENERGY}")
    return channels


def _misfit(path: Path, why: str) -> SettingsError:
    return SettingsError(
        f"features.network={str(path)!r} is no network that catstream can use: {why}. Make one with "
        "`catstream network prepare`"
    )


def _first_line(error: Exception) -> str:
    """The first line of what a runtime says."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]


def by_onnxruntime(path: Path, data: bytes) -> _Run:
    """What a model computes of a batch of images; `path` is for the error if it cannot be read."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # an error is raised, too
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # it has a class for each kind, all of them private
        raise _misfit(path, f"onnxruntime cannot read it ({_first_line(error)})") from None
    inputs, outputs = ([each.name for each in ends] for ends in (session.get_inputs(), session.get_outputs()))
    if len(inputs) != 1 or len(outputs) != 1:
        raise _misfit(path, f"it has {len(inputs)} inputs and {len(outputs)} outputs, expected one each")
    return lambda images: np.asarray(session.run(outputs, {inputs[0]: images})[0])


def _by_opencv(path: Path, data: bytes) -> _Run:
    """The same by the runtime of OpenCV, which takes twice the time, and does not read every file."""
    import cv2

    def run(images: np.ndarray) -> np.ndarray:
        net.setInput(images)
        return np.asarray(net.forward()).copy()

    try:
        net = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
    except cv2.error:
        install = install_command("network")
        raise MissingExtraError(f"OpenCV cannot read {str(path)!r}, and onnxruntime is missing: {install}") from None
    return one_at_a_time(run)


def _test_image(height: int, width: int) -> np.ndarray:
    """Blobs of random colours, float32 (1, 3, h, w)."""
    colours = np.random.default_rng(0).integers(0, 256, (3, height // CELL, width // CELL))
    return np.kron(colours, np.ones((CELL, CELL)))[None].astype(np.float32)

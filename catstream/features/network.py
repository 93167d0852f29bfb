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

#: Mean squared norm of a vector: the variance of the HOG of a cell.
ENERGY = 0.39
#: Maximum number of channels of a vector.
MAX_CHANNELS = 32

_FACTOR = 16  # largest ratio between `ENERGY` and the mean squared norm in the test image
_TEST_SIZES = ((224, 224), (96, 160))  # of images, height and width

_Run = Callable[[np.ndarray], np.ndarray]


class Network:
    """A network that runs on one thread and has no state between calls.

    SettingsError if the file is not of the kind above; OSError if it cannot be read; MissingExtraError if onnxruntime
    is not installed and OpenCV cannot read the file.
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
    """Number of channels; SettingsError unless the vectors of an image have the right shape and norm."""
    try:
        output = run(_test_image(height, width))
    except Exception as error:  # of onnxruntime or of OpenCV
        raise _invalid(path, f"it rejects a float32 (1, 3, {height}, {width}) ({_first_line(error)})") from None
    channels = output.shape[1] if output.ndim == 4 else 0
    rows, columns = height // STRIDE, width // STRIDE
    if output.dtype != np.float32 or output.shape != (1, channels, rows, columns) or not 0 < channels <= MAX_CHANNELS:
        problem = f"for an image of {height} x {width} its output is {output.dtype} {output.shape}"
        raise _invalid(path, f"{problem}, expected float32 (1, 1 to {MAX_CHANNELS}, {rows}, {columns})")
    energy = float((output**2).sum(axis=1).mean())
    if not ENERGY / _FACTOR < energy < ENERGY * _FACTOR:
        raise _invalid(path, f"the mean squared norm of its vectors is {energy:.3g}, expected about {ENERGY}")
    return channels


def _invalid(path: Path, problem: str) -> SettingsError:
    return SettingsError(
        f"features.network={str(path)!r} cannot be used: {problem}; make a network with `catstream network prepare`"
    )


def _first_line(error: Exception) -> str:
    """The first line of the error of a runtime."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]


def by_onnxruntime(path: Path, data: bytes) -> _Run:
    """Return a function that runs a model on a batch of images; `path` is for errors."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised anyway
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of several private classes
        raise _invalid(path, f"onnxruntime cannot read it ({_first_line(error)})") from None
    inputs = [node.name for node in session.get_inputs()]
    outputs = [node.name for node in session.get_outputs()]
    if len(inputs) != 1 or len(outputs) != 1:
        raise _invalid(path, f"it has {len(inputs)} inputs and {len(outputs)} outputs, expected one each")
    return lambda images: np.asarray(session.run(outputs, {inputs[0]: images})[0])


def _by_opencv(path: Path, data: bytes) -> _Run:
    """The same by the runtime of OpenCV, which takes twice the time and cannot read every file."""
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

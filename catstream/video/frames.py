"""`Frame`; `Source`, the base class of files and live sources; and the conversion of images.

A frame is an 8-bit BGR array. `UprightConverter` converts frames of FFmpeg, `as_bgr` arrays of other libraries.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import cv2
import numpy as np

from catstream.base.arrays import is_finite
from catstream.base.text import counted
from catstream.errors import FrameError, VideoError

if TYPE_CHECKING:
    from av import FFmpegError, VideoFrame
    from av.container import InputContainer

#: Default frames per second of a source without time stamps.
RATE = 25.0
#: Interval of the calls of `idle` while a live source has no frame.
IDLE_SECONDS = 0.1

_CHANNELS = (1, 3, 4)
_HALF_STEP = 0.5 / 255  # interpolation may exceed the range from 0 to 1 by this much
_EXPECTED = "a frame is a numpy array (h, w, 3), blue green red, or (h, w) grey, of uint8, uint16 or float from 0 to 1"


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a source.

    number  0, 1, 2 ... over the frames that the source returns; skipped frames have no number
    time    seconds since the start of the video; for a live source, the arrival time
    image   uint8 (h, w, 3), blue green red; a grey image is expanded
    pts     presentation time stamp in a live stream, in seconds of the stream's own clock; None for a file, or if the
            stream has none
    """

    number: int
    time: float
    image: np.ndarray
    pts: float | None = None


class Source(ABC):
    """An iterator over frames, in order and once. Close it, or use it in a `with`.

    name          name for results: the stem of a file, or the name of a folder
    rate          frames per second
    size          (width, height) of the first frame in pixels
    pixel_aspect  width of a pixel divided by its height
    live          whether the source is live: frames that are not read in time are lost
    zero          of a live source: value of `time.monotonic` at time 0 of its frames; None before the first frame
    images        files of the images of a folder, one for each of its frames; empty for a video
    """

    live = False
    zero: float | None = None
    images: Sequence[Path] = ()
    pixel_aspect = Fraction(1)

    def __init__(self, name: str, rate: float, size: tuple[int, int]) -> None:
        self.name, self.rate, self.size = name, rate, size

    @property
    def frames(self) -> int | None:
        """Number of frames of the source; None if it is unknown, for example of a live source."""
        return None

    @property
    def counters(self) -> dict[str, float]:
        """Counters of frames that were lost, by name."""
        return {}

    def __iter__(self) -> Iterator[Frame]:
        return self

    @abstractmethod
    def __next__(self) -> Frame: ...

    @abstractmethod
    def close(self) -> None:
        """Close the source. Iteration afterwards ends at once."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def describe_counters(counters: Mapping[str, float]) -> list[str]:
    """Describe the counters of a file or of images, a line each.

    >>> describe_counters({"truncated": 2})
    ['truncated: the video ends 2 s before the end that its header states']
    """
    lines = []
    if damaged := counters.get("damaged"):
        lines.append(f"damaged: {counted(damaged, 'frame')} could not be decoded, and skipped")
    if scaled := counters.get("scaled"):
        lines.append(f"scaled: {counted(scaled, 'frame')} had another size than the first one")
    if missing := counters.get("truncated"):
        lines.append(f"truncated: the video ends {missing:.0f} s before the end that its header states")
    return lines


def read_ahead(source: Source) -> Generator[Frame]:
    """Yield the frames of a source, and prefetch the next one in a thread: FFmpeg decodes without the GIL.

    Not for live sources, whose prefetched frame would be outdated. An error of the source is raised after the frames
    before it. Close the generator before the source.
    """
    with ThreadPoolExecutor(1, "reader") as reader:
        prefetched = reader.submit(next, source, None)
        while (frame := prefetched.result()) is not None:
            prefetched = reader.submit(next, source, None)
            yield frame


class UprightConverter:
    """Converts frames of PyAV to BGR arrays, rotated and flipped by their display matrix.

    Create one per source: setting up the conversion costs more than the conversion of a frame.
    """

    def __init__(self) -> None:
        from av.sidedata.sidedata import SideDataContainer
        from av.video.reformatter import VideoReformatter

        self._reformatter = VideoReformatter()
        self._side_data: Any = SideDataContainer

    def __call__(self, frame: VideoFrame) -> np.ndarray:
        image = self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray()
        # `frame.side_data` would create a reference cycle, and keep the frame until the next garbage collection.
        matrix: Any = None
        with suppress(ValueError):  # side data of a type that PyAV does not know: EXIF of a JPEG picture
            matrix = self._side_data(frame).get("DISPLAYMATRIX")
        if matrix is not None:
            image = _displayed(image, np.frombuffer(matrix, np.int32).reshape(3, 3)[:2, :2])
        return np.ascontiguousarray(image)


def _displayed(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Rotate and flip an image by a display matrix, whose rows are the directions on the screen of the image's axes.

    An angle is rounded to a multiple of 90 degrees; a matrix of zeros changes nothing.
    """
    (right, _), (_, down) = matrix
    if abs(right) < abs(matrix[0, 1]):
        image, down, right = image.swapaxes(0, 1), matrix[0, 1], matrix[1, 0]
    return image[:: -1 if down < 0 else 1, :: -1 if right < 0 else 1]


def open_video(text: str, hwaccel: str, **options: Any) -> InputContainer:
    """Open a video or a stream with PyAV, with a hardware decoder of the kind `hwaccel` if that is not empty.

    Raises PyAV's errors, and VideoError if there is no such device, or it cannot decode this video.
    """
    import av
    from av.codec.hwaccel import HWAccel, hwdevices_available

    device = HWAccel(hwaccel, allow_software_fallback=False) if hwaccel else None
    try:
        # Metadata, for example a title, may be in any encoding.
        opened: InputContainer = av.open(text, hwaccel=device, metadata_errors="replace", **options)
    except (av.PermissionError, RuntimeError) as error:
        if device is None:
            raise
        raise VideoError(
            f"run.hwaccel={hwaccel} cannot decode this video ({error}): omit it to decode on the processor, or choose "
            f"one of {', '.join(hwdevices_available())}"
        ) from None
    return opened


def video_stream(container: InputContainer) -> Any:
    """Return the video stream, which is not a cover picture; None if there is no video."""
    from av.stream import Disposition

    streams = [container.streams.best("video"), *container.streams.video]
    videos = (stream for stream in streams if stream and not stream.disposition & Disposition.attached_pic)
    return next((stream for stream in videos if stream.codec_context is not None), None)


def ffmpeg_reason(error: FFmpegError) -> str:
    """Return FFmpeg's own description of an error."""
    return (error.strerror or str(error)).lower()


#: Advice for objects of OpenCV that are not arrays.
_CONVERSIONS = {
    "UMat": "pass frame.get()",
    "GpuMat": "pass frame.download()",
    "tuple": "pass the image alone, as in `ok, frame = capture.read()`",
    "str": "pass the image, as cv2.imread returns it",
}


def as_bgr(image: object) -> np.ndarray:
    """Return an image as a writable, contiguous uint8 array (h, w, 3), blue green red; without a copy if possible.

    The shape is (h, w, 3) BGR, (h, w, 4) BGRA, (h, w) or (h, w, 1) grey. uint8 stays as it is; uint16 is reduced to
    its upper 8 bits; floats from 0 to 1 are scaled to 255 and rounded. An alpha channel is dropped. The array may be
    read-only and not contiguous. FrameError for any other array.

    >>> as_bgr(np.full((2, 2, 1), 0.5))[0, 0]
    array([128, 128, 128], dtype=uint8)
    """
    pixels = _eight_bit(_validated(image))
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        pixels = np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2)
    elif pixels.shape[2] == 4:
        pixels = pixels[:, :, :3]
    return np.require(pixels, requirements=["C", "W"])


def _validated(image: object) -> np.ndarray:
    if image is None:
        raise FrameError(
            f"{_EXPECTED}, got None: a read has failed, as at the end of a video; check what it returns first"
        )
    if not isinstance(image, np.ndarray):
        kind = type(image).__name__
        raise FrameError(f"{_EXPECTED}, got {kind}: {_CONVERSIONS.get(kind, 'convert it, as np.asarray does')}")
    shape = image.shape
    if not (image.ndim == 2 or (image.ndim == 3 and shape[2] in _CHANNELS)):
        hint = "pass one of this shape"
        if image.ndim == 3 and shape[0] in _CHANNELS:
            hint = "the channels come last, np.moveaxis(frame, 0, -1) puts them there"
        elif image.ndim == 4:
            hint = "pass one image of a batch at a time"
        raise FrameError(f"{_EXPECTED}, got the shape {shape}: {hint}")
    if not image.size:
        raise FrameError(f"{_EXPECTED}, got the shape {shape}, which has no pixels: check how it was cropped")
    return np.asarray(image)


def _eight_bit(image: np.ndarray) -> np.ndarray:
    if image.dtype == np.uint8:
        return image
    if image.dtype.kind == "u" and image.itemsize == 2:
        return (image >> 8).astype(np.uint8)
    if image.dtype == bool:
        raise FrameError(f"{_EXPECTED}, got bool: a mask is not a picture, 255 * frame.astype(np.uint8) is one")
    if image.dtype.kind not in "fui":
        raise FrameError(f"{_EXPECTED}, got {image.dtype}: check where the frame comes from")
    if image.dtype.kind != "f":
        raise FrameError(
            f"{_EXPECTED}, got {image.dtype}: frame.astype(np.uint8) if its values are brightness from 0 to 255"
        )
    if not is_finite(image):
        raise FrameError(f"{_EXPECTED}, got {image.dtype} with NaN or infinity: check how the frame was computed")
    low, high = float(image.min()), float(image.max())
    if not (low >= -_HALF_STEP and high <= 1 + _HALF_STEP):
        raise FrameError(
            f"{_EXPECTED}, got {image.dtype} from {low:g} to {high:g}: "
            "frame.astype(np.uint8) if its values are brightness from 0 to 255"
        )
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


def jpeg(image: np.ndarray, side: int | None = None, quality: int = 80) -> bytes:
    """An image, uint8 (h, w, 3) BGR or (h, w) grey, as JPEG, scaled down if its longer side exceeds `side` pixels.

    >>> jpeg(np.zeros((480, 1280, 3), np.uint8), side=640)[:3].hex()
    'ffd8ff'
    """
    height, width = image.shape[:2]
    if side is not None and (scale := side / max(height, width)) < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()

"""Image files as frames: the files of a folder or a pattern, or the pages of one file."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from catstream.errors import VideoError

#: Suffixes of the files in a folder that are read as images.
_IMAGES = "avif bmp dib hdr jfif jp2 jpe jpeg jpg pam pbm pfm pgm png pnm ppm ras sr tif tiff webp"
IMAGES = {f".{suffix}" for suffix in _IMAGES.split()}
#: Suffixes of formats with several pages, which FFmpeg does not read. It reads the frames of APNG and AVIF.
_PAGED = {".tif", ".tiff", ".webp"}
_BATCH = 32  # pages of a file that are decoded together
_ANY = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
EXPECTED = "pass a video file, a folder of images, a pattern like images/%05d.png, or rtsp:// and http:// for a stream"

_log = logging.getLogger(__name__)


def image_files(path: Path) -> list[Path]:
    """Return the image files in a folder, or those that match a pattern (%05d, *), in natural order, at least one."""
    if path.is_dir():
        files = visible(path, IMAGES)
    elif number := re.search(r"%0?(\d*)d", path.name):
        digits = rf"\d{{{number[1]},}}" if number[1] else r"\d+"
        name = re.escape(path.name[: number.start()]) + digits + re.escape(path.name[number.end() :])
        files = [file for file in path.parent.glob("*") if re.fullmatch(name, file.name)]
    else:
        files = list(path.parent.glob(path.name))
    files = [file for file in files if not file.name.startswith(".")]
    if not files:
        kinds = ", ".join(sorted(suffix[1:] for suffix in IMAGES))
        raise VideoError(f"no images at {str(path)!r}: {EXPECTED} (images are {kinds})")
    return sorted(files, key=natural_order)


def visible(folder: Path, kinds: set[str]) -> list[Path]:
    """Return the files in a folder that have one of these suffixes and are not hidden."""
    return [file for file in folder.iterdir() if file.suffix.lower() in kinds and not file.name.startswith(".")]


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts 10 after 2."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def pages_of(path: Path) -> list[tuple[Path, int]]:
    """Return the pages of an image file; an empty list if it is not an image, or FFmpeg has to read it."""
    suffix = path.suffix.lower()
    count = _page_count(path) if suffix in IMAGES else 0
    return [(path, page) for page in range(count)] if count == 1 or suffix in _PAGED else []


def first_pages(files: list[Path]) -> list[tuple[Path, int]]:
    """Return the first page of each file, and log once that there are more."""
    if (count := _page_count(files[0])) > 1:
        _log.warning(
            "%s has %d pages, of which only the first is read in a folder: pass the file itself", files[0], count
        )
    return [(file, 0) for file in files]


def _page_count(path: Path) -> int:
    """Return the number of pages of an image file, 1 for most; 0 if OpenCV cannot read it."""
    try:
        with path.open("rb") as file, _without_warnings():
            # On Linux by descriptor: OpenCV crashes on names that are not UTF-8.
            return cv2.imcount(f"/proc/self/fd/{file.fileno()}" if sys.platform == "linux" else str(path))
    except (OSError, cv2.error):
        return 0


class ImageReader:
    """Reads images as uint8 (h, w, 3), blue green red.

    Images of more than 8 bits or of floats are scaled by the range of the first image: its darkest pixel becomes 0, its
    brightest one 255.

    pages  files, and the number of the page in each
    """

    def __init__(self, pages: list[tuple[Path, int]]) -> None:
        self.pages = pages
        self._range: tuple[float, float] | None = None

    def __call__(self, number: int) -> np.ndarray | None:
        """Return an image by its number; None if it cannot be read."""
        image = _decoded(*self.pages[number])
        if image is None:
            return None
        if image.dtype != np.uint8:
            if self._range is None:
                first = _decoded(*self.pages[0])
                self._range = _range(image if first is None else first)
            low, high = self._range
            scaled = (image - low) * (255 / (high - low)) if high > low else np.zeros(image.shape)
            image = np.nan_to_num(scaled).clip(0, 255).round().astype(np.uint8)
        return image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def of_one_size(image: np.ndarray, shape: tuple[int, ...], resize: bool, path: Path, number: int) -> np.ndarray:
    """Return an image in the size of the first one. Raises VideoError if it has another size, unless `resize`."""
    if image.shape == shape:
        return image
    if resize:
        return cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    raise VideoError(
        f"all images of a source need one size: {str(path)!r} (frame {number}) is {image.shape[1]}x{image.shape[0]}, "
        f"the first {shape[1]}x{shape[0]}: --set run.resize=true scales it to that"
    )


def _range(image: np.ndarray) -> tuple[float, float]:
    """The smallest and the largest finite value of an image."""
    finite = image[np.isfinite(image)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)


def _decoded(path: Path, page: int) -> np.ndarray | None:
    """Return a page, (h, w, 3) or grey (h, w) of any type; None if it cannot be read."""
    with _without_warnings():
        try:
            if page:
                return _batch(path, page // _BATCH)[page % _BATCH]
            # cv2.imread crashes on names that are not UTF-8, and decodes truncated JPEGs.
            data = path.read_bytes()
            if _is_cut_off(data):
                return None
            return cv2.imdecodemulti(np.frombuffer(data, np.uint8), _ANY, range=(0, 1))[1][0]
        except (OSError, cv2.error, IndexError):  # or it is empty, or larger than OpenCV's limit
            return None


@lru_cache(maxsize=1)
def _batch(path: Path, number: int) -> Sequence[np.ndarray]:
    """Return a batch of pages. OpenCV skips earlier pages, except of a WebP, whose pages it miscounts."""
    data = np.memmap(path, np.uint8, "r")  # a stack of pages may be large
    if path.suffix.lower() == ".webp":
        return cv2.imdecodemulti(data, _ANY)[1][_BATCH * number :]
    return cv2.imdecodemulti(data, _ANY, range=(_BATCH * number, _BATCH * (number + 1)))[1]


def _is_cut_off(data: bytes) -> bool:
    """Return True if this is a JPEG without an end of the image (FF D9) after its first scan (FF DA)."""
    start = 2
    while data[start : start + 1] == b"\xff" and data[start + 1 : start + 2] != b"\xda":
        start += 2 + int.from_bytes(data[start + 2 : start + 4])  # skip a segment by its length
    return data.startswith(b"\xff\xd8\xff") and data[start : start + 1] == b"\xff" and b"\xff\xd9" not in data[start:]


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Suppress the warnings of OpenCV about files that it cannot read."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)

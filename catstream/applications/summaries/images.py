"""Summarises a collection of images by the k images that keep most of its energy.

Each image is one feature row x, see `describe`; A has the rows of all images. The images of a summary are those whose
rows span a subspace with projection P that keeps most of ||A||^2, the sum of all squares.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from catstream.applications.summaries.selection import RowSelection, Selection
from catstream.errors import VideoError
from catstream.features.cells import Cells
from catstream.features.layout import CELL, WINDOW
from catstream.numerics.threads import one_thread
from catstream.video.frames import as_bgr
from catstream.video.source import read_image

_SIDE = WINDOW * CELL


def describe(image: np.ndarray) -> np.ndarray:
    """Feature row of a whole image: that of a window of the tracker which contains all of it.

    The image is resized to 64 x 64 pixels, so that images of all sizes have rows of one length: HOG and mean colour of
    8 x 8 cells, and the histogram of the colours in the middle. Its energy is high if the image has edges and colours.

    Parameters
    ----------
    image : uint8 (h, w, 3), blue green red

    Returns
    -------
    float32 (d,)

    >>> describe(np.zeros((480, 640, 3), np.uint8)).shape
    (2464,)
    """
    return Cells.of(cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)).row(0, 0)


def summarize(images: Iterable[np.ndarray | str | os.PathLike[str]], k: int) -> Selection[int]:
    """Select the k images that keep most of the energy of a collection, in one pass and constant memory.

    The images are read one after the other and may have different sizes. Each is described by one feature row; A has
    the rows of all images. With P the projection on the span of the selected rows, the selection makes
    ||A P||^2 / ||A||^2 large: images that differ from one another and resemble many others. On real collections it is
    as large as that of the greedy choice from all rows at once.

    Parameters
    ----------
    images : iterable of ndarray or path
        Arrays as for `Tracker`, or image files.
    k : int
        Number of images to select.

    Returns
    -------
    Selection
        The numbers of the selected images, from 0, and how much energy they keep.

    Raises
    ------
    SettingsError
        If k is below 1, or there are fewer than k images.
    VideoError
        If a file is not an image that can be read, or if `images` is one path.
    FrameError
        If an array is not an image.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> red, green = rng.integers(0, 256, (2, 48, 64, 3), np.uint8)
    >>> sorted(summarize([red, red, green, red], k=2).selected)
    [0, 2]
    """
    if isinstance(images, str | os.PathLike):
        raise VideoError(
            f"expected an iterable of images, got the path {os.fspath(images)!r}: give a list of files, such as "
            "[*Path(FOLDER).iterdir()]"
        )
    selection = RowSelection[int](k)
    for number, image in enumerate(images):
        with one_thread():
            selection.add(describe(as_bgr(_read(image))), number)
    with one_thread():
        return selection.result()


def _read(image: np.ndarray | str | os.PathLike[str]) -> object:
    if not isinstance(image, str | os.PathLike):
        return image
    pixels = read_image(Path(image))
    if pixels is None:
        raise VideoError(f"cannot read the image {os.fspath(image)!r}: replace it, or leave it out")
    return pixels

"""Conversion of arrays to frames, and reading ahead."""

from __future__ import annotations

import threading
from contextlib import closing

import numpy as np
import pytest

from catstream.errors import FrameError, VideoError
from catstream.video.frames import Frame, Source, as_bgr, read_ahead


@pytest.fixture
def bgr(rng):
    return rng.integers(0, 256, (6, 8, 3), np.uint8)


def test_bgr_frame_is_not_copied(bgr):
    assert as_bgr(bgr) is bgr


@pytest.mark.parametrize(
    "form",
    [
        lambda image: np.frombuffer(image.tobytes(), np.uint8).reshape(image.shape),
        lambda image: image.astype(np.uint16) * 257,
        lambda image: (image.astype(np.uint16) * 257).astype(">u2"),
        lambda image: image / 255,
        lambda image: image.astype(np.float32) / 255,
        lambda image: np.dstack([image, np.zeros_like(image[:, :, :1])]),
        lambda image: np.asfortranarray(image),
        lambda image: image[::-1, ::-1].copy()[::-1, ::-1],
        lambda image: np.ma.masked_array(image),
    ],
    ids=["read-only", "uint16", "big-endian", "float64", "float32", "alpha", "columns", "view", "masked"],
)
def test_array_is_converted_to_a_contiguous_bgr_image(bgr, form):
    found = as_bgr(form(bgr))
    np.testing.assert_array_equal(found, bgr)
    assert type(found) is np.ndarray
    assert found.dtype == np.uint8
    assert found.flags.c_contiguous
    assert found.flags.writeable


@pytest.mark.parametrize("form", [lambda grey: grey, lambda grey: grey[:, :, None]], ids=["plane", "channel"])
def test_grey_image_is_expanded(bgr, form):
    grey = bgr[:, :, 0]
    np.testing.assert_array_equal(as_bgr(form(grey)), np.dstack([grey] * 3))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (None, "got None: a read has failed"),
        ([[1, 2], [3, 4]], "got list: convert it, as np.asarray does"),
        ((True, np.zeros((4, 5, 3), np.uint8)), "got tuple: pass the image alone"),
        (np.zeros((4, 5, 3), bool), "got bool: a mask is not a picture"),
        (np.zeros((3, 4, 5), np.uint8), r"got the shape \(3, 4, 5\): the channels come last"),
        (np.zeros((2, 4, 5, 3), np.uint8), r"got the shape \(2, 4, 5, 3\): pass one image of a batch"),
        (np.zeros((0, 5, 3), np.uint8), "has no pixels"),
        (np.full((4, 5, 3), 200.0), "got float64 from 200 to 200: frame.astype"),
        (np.full((4, 5, 3), np.nan), "got float64 with NaN or infinity: check how the frame was computed"),
    ],
)
def test_invalid_image_is_an_error_with_a_remedy(image, message):
    with pytest.raises(FrameError, match=message):
        as_bgr(image)


class Numbers(Source):
    """A number of frames, and then an error or the end."""

    def __init__(self, count, problem=None):
        super().__init__("numbers", 25.0, (8, 8))
        self.read, self.readers = 0, set()
        self._count, self._problem = count, problem

    def __next__(self):
        self.readers.add(threading.current_thread().name)
        if self.read == self._count:
            raise self._problem or StopIteration
        self.read += 1
        return Frame(self.read - 1, 0.0, np.zeros((8, 8, 3), np.uint8))

    def close(self):
        pass


def test_error_is_raised_after_the_frames_before_it():
    frames = read_ahead(Numbers(2, VideoError("it breaks at frame 2")))
    assert [next(frames).number, next(frames).number] == [0, 1]
    with pytest.raises(VideoError, match="frame 2"):
        next(frames)


def test_read_ahead_prefetches_one_frame_and_ends_its_thread():
    source = Numbers(50)
    with closing(read_ahead(source)) as frames:
        for frame in frames:
            assert source.read <= frame.number + 2
            if frame.number == 7:
                break
    (reader,) = source.readers
    assert reader not in {thread.name for thread in threading.enumerate()}

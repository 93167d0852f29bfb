"""Reading ahead."""

import threading
from contextlib import closing

import numpy as np
import pytest

from catstream.errors import VideoError
from catstream.video.frames import Frame, Source, read_ahead


class Numbers(Source):
    """So many frames, then what is wrong with the next one."""

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


def test_frames_are_yielded_in_order_from_another_thread():
    source = Numbers(5)
    assert [frame.number for frame in read_ahead(source)] == [0, 1, 2, 3, 4]
    assert len(source.readers) == 1
    assert threading.current_thread().name not in source.readers


def test_an_error_of_the_source_is_raised_after_the_frames_before_it():
    frames = read_ahead(Numbers(2, VideoError("it breaks at frame 2")))
    assert [next(frames).number, next(frames).number] == [0, 1]
    with pytest.raises(VideoError, match="frame 2"):
        next(frames)


def test_at_most_one_frame_is_read_ahead_and_the_thread_ends_with_the_generator():
    source = Numbers(50)
    with closing(read_ahead(source)) as frames:
        for frame in frames:
            assert source.read <= frame.number + 2
            if frame.number == 7:
                break
    (reader,) = source.readers
    assert reader not in {thread.name for thread in threading.enumerate()}

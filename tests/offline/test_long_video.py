"""A long video: annotation costs in proportion to the annotated stretch."""

import resource
import tempfile

import av
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.base.workers import run_tasks
from catstream.offline.annotation import Annotation
from catstream.video.video_frames import VideoFrames

FRAMES, SIZE = 30_000, (64, 48)
STRETCH = range(20_000, 20_024)
MOST_BYTES = 150 << 20  # of memory; all images have 276 MB


def box_at(frame: int) -> Box:
    return Box(8 + abs(frame % 64 - 32), 16, 16, 16)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """A square that moves to and fro, with a keyframe every ten seconds."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("long") / "long.mp4"
    background = rng.integers(0, 256, (12, 16, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    square = rng.integers(0, 256, (8, 8, 3), np.uint8).repeat(2, 0).repeat(2, 1)
    with av.open(str(path), "w") as container:
        coding = {"preset": "ultrafast", "x264-params": "keyint=250:bframes=2:threads=1"}
        stream = container.add_stream("libx264", rate=25, options=coding)
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for number in range(FRAMES):
            image, (x, y, w, h) = background.copy(), map(int, box_at(number))
            image[y : y + h, x : x + w] = square
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    return path


def growth(frames: VideoFrames) -> int:
    """Read all images backwards; returns the growth of the peak of the process's memory, in bytes."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in reversed(range(len(frames))):
        frames[number]
    return 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)


def test_long_video_is_read_in_bounded_memory(video):
    frames = VideoFrames(video)
    frames.scan()
    assert len(frames) == FRAMES
    assert not frames.is_exact
    (grown,) = run_tasks(growth, [(frames,)], 1)
    assert grown < MOST_BYTES


def test_stretch_of_a_long_video_is_annotated_alone(video, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    ends = STRETCH[0], STRETCH[-1]
    with Annotation(video, {frame: box_at(frame) for frame in ends}, jobs=1) as annotation:
        annotation.scan()
        between = [task for task in annotation.missing() if {task.start, task.stop} == {*ends}]
        for future, _ in map(annotation.submit, between):
            annotation.store(future)
        stored = sum(file.stat().st_size for file in tmp_path.rglob("*"))
        tracks = annotation.tracks[""]
    assert stored < 1 << 20
    assert all(tracks[frame].box.overlap(box_at(frame)) > 0.5 for frame in STRETCH)
    assert {tracks[frame].checked for frame in STRETCH[1:-1]} == {"checked"}

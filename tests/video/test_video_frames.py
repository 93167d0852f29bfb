"""Frames by number: for each kind of file, those that `open_source` returns in order."""

from __future__ import annotations

import pickle
import random
from pathlib import Path

import cv2
import numpy as np
import pytest

from catstream.base.settings import RunSettings
from catstream.errors import VideoError
from catstream.video import video_frames
from catstream.video.source import ALL_FRAMES, open_source
from catstream.video.video_frames import VideoFrames
from tests.video.test_source import damaged, encoded, numbered

FRAMES = 40
B_FRAMES = (("v:x264-params", "keyint=8:bframes=3"),)
OPEN = (("v:x264-params", "keyint=8:bframes=3:open-gop=1"),)
IRREGULAR = tuple((number + number // 3) / 25 for number in range(FRAMES))

#: Name, how it is made, and whether its frames are numbered from the packets alone.
KINDS = [
    ("b-frames.mp4", {"options": B_FRAMES}, True),
    ("open-groups.mp4", {"options": OPEN}, True),
    ("open-groups.mkv", {"options": OPEN, "sound": 1.0}, True),
    ("one-keyframe.mp4", {"options": (("v:x264-params", "keyint=999:bframes=2"),)}, True),
    ("refreshed.mp4", {"options": (("v:x264-params", "keyint=10:intra-refresh=1"),)}, True),
    ("irregular.mkv", {"options": B_FRAMES, "times": IRREGULAR}, True),
    ("fragments.mp4", {"options": (("movflags", "frag_keyframe+empty_moov"), *B_FRAMES)}, True),
    ("turned.mov", {"rotation": 90}, True),
    ("open-groups.ts", {"options": OPEN, "sound": 1.0}, False),
    ("raw.h264", {"options": B_FRAMES}, False),
    ("groups.flv", {"options": B_FRAMES}, False),
    ("pictures.avi", {}, False),
    ("groups.mpg", {"options": (("v:g", "6"), ("v:bf", "2"))}, False),
]


def sequence(path: Path, part: slice = ALL_FRAMES, **settings: object) -> tuple[list[np.ndarray], list[float], dict]:
    """The images that are read in order, before the first damaged one, their times, and the counters."""
    images, times = [], []
    with open_source(path, part=part, **settings) as source:
        try:
            for frame in source:
                images.append(frame.image)
                times.append(frame.time)
        except VideoError:
            pass
        return images, times, source.counters


def assert_same(frames: VideoFrames, images: list[np.ndarray], times: list[float]) -> None:
    assert list(frames.times) == times
    forwards = [*range(len(images))]
    for number in [*forwards, *reversed(forwards), *random.Random(0).sample(forwards, len(forwards))]:
        assert np.array_equal(frames[number], images[number]), number


@pytest.fixture(autouse=True)
def small_cache(monkeypatch):
    monkeypatch.setattr(video_frames, "_CACHE_BYTES", 5 * 160 * 120 * 12 // 8)


@pytest.fixture
def made(tmp_path):
    def make(name: str, how: dict) -> Path:
        path = tmp_path / name
        path.write_bytes(encoded(path.suffix, FRAMES, **how))
        return path

    return make


@pytest.mark.parametrize("part", [ALL_FRAMES, slice(5, 33, 3)], ids=str)
@pytest.mark.parametrize(("name", "how", "from_packets"), KINDS, ids=[kind[0] for kind in KINDS])
def test_frames_in_any_order_are_those_in_order(made, name, how, from_packets, part):
    path = made(name, how)
    frames = VideoFrames(path, part)
    images, times, _ = sequence(path, part)
    assert np.array_equal(frames[0], images[0])
    assert len(frames) == 1
    frames.scan()
    assert frames.is_exact is not from_packets
    assert_same(frames, images, times)


@pytest.mark.parametrize("name", ["b-frames.mp4", "open-groups.mkv", "open-groups.ts", "raw.h264", "groups.mpg"])
def test_frames_around_damage_are_those_in_order(made, name):
    path = damaged(made(name, {kind: how for kind, how, _ in KINDS}[name]), 0.6)
    images, times, counters = sequence(path, skip_damaged=True)
    frames = VideoFrames(path, settings=RunSettings(skip_damaged=True))
    frames.scan()
    assert_same(frames, images, times)
    assert frames.counters == counters

    images, times, _ = sequence(path)
    assert len(images) < FRAMES
    frames = VideoFrames(path)
    message = f"^{len(images)} frames could be read: .* is damaged at frame {len(images)} "
    if name.endswith(("mp4", "mkv")):  # the packets do not show the damage
        frames.scan()
        with pytest.raises(VideoError):
            [frames[number] for number in range(len(frames))]
    with pytest.raises(VideoError, match=message):
        frames.scan(exact=True)
    assert_same(frames, images, times)


def test_the_frames_before_the_end_of_a_truncated_file_are_read(made):
    path = made("b-frames.mkv", {"options": B_FRAMES})
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    frames = VideoFrames(path)
    frames.scan()
    images, times, counters = sequence(path)
    assert_same(frames, images, times)
    assert frames.counters == counters


@pytest.mark.parametrize("kind", ["folder", "pages.tiff"])
def test_images_are_read_by_their_number(tmp_path, kind):
    path, images = tmp_path / kind, [numbered(number) for number in range(40)]
    if kind == "folder":
        path.mkdir()
        for number, image in enumerate(images):
            cv2.imwrite(str(path / f"{number}.png"), image)
    else:
        cv2.imwritemulti(str(path), images)
    frames = VideoFrames(path, slice(3, 40, 2))
    frames.scan()
    assert_same(frames, images[3:40:2], [number / 25 for number in range(3, 40, 2)])
    if kind == "folder":
        (path / "9.png").write_bytes(b"none")
        with pytest.raises(VideoError, match=r"^3 frames could be read: .*9\.png"):
            frames.scan(exact=True)
        assert len(frames) == 3


def test_a_copy_in_another_process_reads_the_same_frames(made):
    path = made("b-frames.mp4", {"options": B_FRAMES})
    frames = VideoFrames(path)
    frames.scan()
    images, times, _ = sequence(path)
    assert_same(pickle.loads(pickle.dumps(frames)), images, times)

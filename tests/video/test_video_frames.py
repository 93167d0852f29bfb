"""Frames by number: for each kind of file, the frames that `open_source` returns in order."""

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
from tests.video.pictures import damaged, make_video, numbered

FRAMES = 40
B_FRAMES = {"v:x264-params": "keyint=8:bframes=3"}
OPEN = {"v:x264-params": "keyint=8:bframes=3:open-gop=1"}
IRREGULAR = tuple((number + number // 3) / 25 for number in range(FRAMES))

#: Videos by name, how they are made, and whether their frames are numbered from the packets alone.
KINDS = {
    "b-frames.mp4": ({"options": B_FRAMES}, True),
    "open-groups.mp4": ({"options": OPEN}, True),
    "open-groups.mkv": ({"options": OPEN, "sound": 1.0}, True),
    "one-keyframe.mp4": ({"options": {"v:x264-params": "keyint=999:bframes=2"}}, True),
    "refreshed.mp4": ({"options": {"v:x264-params": "keyint=10:intra-refresh=1"}}, True),
    "irregular.mkv": ({"options": B_FRAMES, "times": IRREGULAR}, True),
    "fragments.mp4": ({"options": {"movflags": "frag_keyframe+empty_moov", **B_FRAMES}}, True),
    "turned.mov": ({"rotation": 90}, True),
    "open-groups.ts": ({"options": OPEN, "sound": 1.0}, False),
    "raw.h264": ({"options": B_FRAMES}, False),
    "groups.flv": ({"options": B_FRAMES}, False),
    "pictures.avi": ({}, False),
    "groups.mpg": ({"options": {"v:g": "6", "v:bf": "2"}}, False),
}


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


@pytest.mark.parametrize("part", [ALL_FRAMES, slice(5, 33, 3)], ids=str)
@pytest.mark.parametrize("name", KINDS)
def test_frames_by_number_equal_the_frames_in_order(tmp_path, name, part):
    options, from_packets = KINDS[name]
    path = make_video(tmp_path / name, FRAMES, **options)
    frames = VideoFrames(path, part)
    images, times, _ = sequence(path, part)
    assert np.array_equal(frames[0], images[0])
    assert len(frames) == 1
    frames.scan()
    assert frames.is_exact is not from_packets
    assert_same(frames, images, times)


@pytest.mark.parametrize("name", ["b-frames.mp4", "open-groups.mkv", "open-groups.ts", "raw.h264", "groups.mpg"])
def test_frames_around_damage_equal_the_frames_in_order(tmp_path, name):
    path = damaged(make_video(tmp_path / name, FRAMES, **KINDS[name][0]), 0.6)
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


def test_truncated_file_is_read_to_its_end(tmp_path):
    path = make_video(tmp_path / "b-frames.mkv", FRAMES, B_FRAMES)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    frames = VideoFrames(path)
    frames.scan()
    images, times, counters = sequence(path)
    assert_same(frames, images, times)
    assert frames.counters == counters


@pytest.mark.parametrize("kind", ["folder", "pages.tiff"])
def test_images_are_read_by_number(tmp_path, kind):
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


def test_pickled_copy_reads_the_same_frames(tmp_path):
    path = make_video(tmp_path / "b-frames.mp4", FRAMES, B_FRAMES)
    frames = VideoFrames(path)
    frames.scan()
    images, times, _ = sequence(path)
    assert_same(pickle.loads(pickle.dumps(frames)), images, times)

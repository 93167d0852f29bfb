"""Annotated video: drawing, colours and the file."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from catstream.base.box import Box
from catstream.errors import VideoError
from catstream.video.drawing import PALETTE, Colours, draw, drawn_size
from catstream.video.source import open_source
from catstream.video.writer import VideoWriter
from catstream.wire.messages import State, Track

BOX = Box(40, 30, 60, 40)


def frame_times(path: Path) -> list[float]:
    with open_source(path) as source:
        return [frame.time for frame in source]


def track(state: State = "present", box: Box | None = BOX, frame: int = 7) -> Track:
    return Track(frame, 0.0, state, box, 0.8, 3)


@pytest.mark.parametrize("state", ["bootstrapping", "present", "absent"])
@pytest.mark.parametrize("size", [(320, 240), (1921, 1081), (70, 50)])
def test_drawing_copies_the_frame_with_text_below_it(state, size):
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    drawn = draw(image, [track(state, None if state == "absent" else BOX)], Colours())
    assert (drawn.shape[1::-1], drawn.shape[2]) == (drawn_size(size), 3)
    assert drawn.shape[1] == size[0]
    assert (image == 128).all()
    assert (drawn[: size[1]] != 128).any() == (state != "absent")
    assert (drawn[size[1] :] != 128).any()


def test_each_object_is_drawn_in_its_own_colour(rng):
    image, colours = rng.integers(0, 256, (240, 320, 3), np.uint8), Colours()
    anna, ben = replace(track(), object="anna"), replace(track(box=Box(200, 90, 50, 60)), object="ben")

    def has_colour(part, name):
        red, green, blue = bytes.fromhex(colours.of(name)[1:])
        return (part == (blue, green, red)).all(axis=2).sum() > 9

    for tracks in ([anna, ben], [ben, anna], [ben]):
        drawn = draw(image, tracks, colours)
        for name in ("anna", "ben"):
            is_drawn = any(each.object == name for each in tracks)
            assert has_colour(drawn[:240], name) == is_drawn, "its box and its name"
            assert has_colour(drawn[240:], name) == is_drawn, "its score"


@pytest.mark.parametrize("size", [(70, 50), (1920, 1080)])
@pytest.mark.parametrize("box", [Box(-500, -500, 10, 10), Box(-50, -50, 900, 3), Box(60, 45, 4, 4), Box(5, 5, 0, 0)])
def test_objects_with_long_names_are_drawn_in_any_picture(size, box):
    tracks = [replace(track(box=box), object=f"{k}-" + 60 * "ë") for k in range(32)]
    assert draw(np.zeros((size[1], size[0], 3), np.uint8), tracks, Colours()).shape[1] == size[0]


@pytest.mark.parametrize("size", [(320, 240), (99, 77)])
def test_video_has_each_frame_at_any_size(tmp_path, size):
    path = tmp_path / "deep" / "out.mp4"
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    with VideoWriter(path, 29.97, size, pixel_aspect=Fraction(2)) as video:
        for _ in range(9):
            video.write(image)
    with open_source(path) as source:
        assert (source.rate, source.pixel_aspect) == (pytest.approx(29.97), 2)
        width, height = source.size
        assert (width, height) == tuple(side + side % 2 for side in size)
        assert sum(1 for _ in source) == 9
    assert [file.name for file in path.parent.iterdir()] == ["out.mp4"]


@pytest.mark.parametrize(
    ("rate", "times", "precision"), [(25, [2.0, 2.04, 2.5, 2.52, 9.0], 0.001), (1 / 3600, [2.0, 3602.0, 7202.0], 10)]
)
def test_written_frames_keep_their_time_stamps(tmp_path, rate, times, precision):
    with VideoWriter(tmp_path / "out.mp4", rate, (64, 64)) as video:
        for time in times:
            video.write(np.zeros((64, 64, 3), np.uint8), time)
    assert frame_times(tmp_path / "out.mp4") == pytest.approx([time - 2 for time in times], abs=precision)


def test_video_is_locked_while_it_is_written(tmp_path):
    path = tmp_path / "out.mp4"
    with VideoWriter(path, 25, (64, 64)) as video:
        for _ in range(3):
            video.write(np.zeros((64, 64, 3), np.uint8))
            with pytest.raises(VideoError, match=r"out\.mp4 is being written by process"):
                VideoWriter(path, 25, (64, 64))
    assert len(frame_times(path)) == 3


def test_interrupted_or_empty_video_leaves_no_file(tmp_path):
    with VideoWriter(tmp_path / "empty.mp4", 25, (64, 64)):
        pass
    with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "out.mp4", 25, (64, 64)) as video:  # noqa: PT012
        video.write(np.zeros((64, 64, 3), np.uint8))
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("rate", [2, 25])
def test_video_of_a_killed_process_is_readable(tmp_path, rate):
    killed = (
        "import numpy as np, os, sys; from catstream.video.writer import VideoWriter\n"
        "video, rate = VideoWriter('out.mp4', 25, (64, 64)), int(sys.argv[1])\n"
        "for frame in range(9 * rate + 1): video.write(np.zeros((64, 64, 3), np.uint8), frame / rate)\n"
        "os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-P", "-c", killed, str(rate)], cwd=tmp_path, check=False)
    times = frame_times(tmp_path / "out.mp4")
    assert times == pytest.approx([frame / rate for frame in range(len(times))])
    assert times[-1] >= 8 - 1 / rate


@pytest.mark.parametrize("frames", [0, 200], ids=["at its end", "while it is written"])
def test_full_disk_is_an_error_and_the_video_is_readable(tmp_path, rng, full, frames):
    image = rng.integers(0, 256, (240, 320, 3), np.uint8)  # noise, which no codec makes small
    video = VideoWriter(tmp_path / "out.mp4", 25, (320, 240))

    def run():
        with closing(video):
            for _ in range(60):
                video.write(image)
            full(tmp_path / "out.mp4")
            for _ in range(frames):
                video.write(image)

    with pytest.raises(VideoError, match=r"cannot write the video .*/out\.mp4: No space left on device$"):
        run()
    assert len(frame_times(tmp_path / "out.mp4")) >= 50


def test_invalid_path_is_an_error_of_the_writer(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(VideoError, match="cannot write the video"):
        VideoWriter(tmp_path / "file" / "out.mp4", 25, (64, 64))


@given(some.lists(some.tuples(some.booleans(), some.sampled_from("abcdefghijkl"))))
def test_colour_of_an_object_does_not_change(events):
    colours, living = Colours(), {}
    for comes, name in events:
        if comes:
            living[name] = colours.of(name)
        else:
            living.pop(name, None)
            colours.keep(living)
        assert {name: colours.of(name) for name in living} == living


def test_palette_is_used_whole_before_a_colour_repeats():
    colours = Colours()
    assert {colours.of(str(number)) for number in range(len(PALETTE))} == {*PALETTE}

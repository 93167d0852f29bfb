"""Annotated video: every frame, any size, whole or not there; colours that can be told apart, and stay."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from fractions import Fraction

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


def track(state: State = "present", box: Box | None = BOX, frame: int = 7) -> Track:
    return Track(frame, 0.0, state, box, 0.8, 3)


@pytest.mark.parametrize("state", ["bootstrapping", "present", "absent"])
@pytest.mark.parametrize("size", [(640, 480), (320, 240), (1921, 1081), (70, 50)])
def test_drawing_does_not_change_the_frame_and_the_text_is_below_it(state, size):
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    drawn = draw(image, [track(state, None if state == "absent" else BOX)], Colours())
    assert (drawn.shape[1::-1], drawn.shape[2]) == (drawn_size(size), 3)
    assert drawn.shape[1] == size[0]
    assert (image == 128).all()
    assert (drawn[: size[1]] != 128).any() == (state != "absent")
    assert (drawn[size[1] :] != 128).any()


def test_each_object_is_drawn_in_its_own_colour_which_stays(rng):
    image, colours = rng.integers(0, 256, (240, 320, 3), np.uint8), Colours()
    anna, ben = replace(track(), object="anna"), replace(track(box=Box(200, 90, 50, 60)), object="ben")
    for tracks in ([anna, ben], [ben, anna], [ben]):
        drawn = draw(image, tracks, colours)
        for each in tracks:
            assert has_colour(drawn[:240], colours.of(each.object)), "its box and its name"
            assert has_colour(drawn[240:], colours.of(each.object)), "its score"
    assert not has_colour(drawn, colours.of("anna"))
    assert colours.of("anna") != colours.of("ben")


def has_colour(image, colour):
    red, green, blue = bytes.fromhex(colour[1:])
    return (image == (blue, green, red)).all(axis=2).sum() > 9


@pytest.mark.parametrize("size", [(70, 50), (352, 288), (1920, 1080)])
@pytest.mark.parametrize(
    "box", [BOX, Box(-500, -500, 10, 10), Box(-50, -50, 900, 3), Box(60, 45, 4, 4), Box(5, 5, 0, 0), None]
)
def test_many_objects_with_long_names_can_be_drawn_in_any_picture(size, box):
    tracks = [replace(track(box=box), object=f"{k}-" + 60 * "ë") for k in range(32)]
    assert draw(np.zeros((size[1], size[0], 3), np.uint8), tracks, Colours()).shape[1] == size[0]


@pytest.mark.parametrize("size", [(640, 480), (321, 241), (99, 77)])
def test_the_video_has_each_frame_written_at_any_size(tmp_path, size):
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
def test_frames_keep_the_time_stamps_of_the_source(tmp_path, rate, times, precision):
    with VideoWriter(tmp_path / "out.mp4", rate, (64, 64)) as video:
        for time in times:
            video.write(np.zeros((64, 64, 3), np.uint8), time)
    with open_source(tmp_path / "out.mp4") as source:
        assert [frame.time + 2 for frame in source] == pytest.approx(times, abs=precision)


def test_a_video_that_is_being_written_is_refused_to_another_writer(tmp_path):
    path, image = tmp_path / "out.mp4", np.zeros((64, 64, 3), np.uint8)
    with VideoWriter(path, 25, (64, 64)) as video:
        for _ in range(3):
            video.write(image)
            with pytest.raises(VideoError, match=r"out\.mp4 is being written by process"):
                VideoWriter(path, 25, (64, 64))
    with open_source(path) as source:
        assert sum(1 for _ in source) == 3


def test_a_video_that_was_interrupted_or_has_no_frame_leaves_no_file(tmp_path):
    with VideoWriter(tmp_path / "empty.mp4", 25, (64, 64)):
        pass
    with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "out.mp4", 25, (64, 64)) as video:  # noqa: PT012
        video.write(np.zeros((64, 64, 3), np.uint8))
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def decoded(path):
    with open_source(path) as source:
        return [frame.time for frame in source]


@pytest.mark.parametrize("rate", [2, 25])
def test_the_video_of_a_killed_process_is_readable_up_to_the_last_second(tmp_path, rate):
    killed = (
        "import numpy as np, os, sys; from catstream.video.writer import VideoWriter\n"
        "video, rate = VideoWriter('out.mp4', 25, (64, 64)), int(sys.argv[1])\n"
        "for frame in range(9 * rate + 1): video.write(np.zeros((64, 64, 3), np.uint8), frame / rate)\n"
        "os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-P", "-c", killed, str(rate)], cwd=tmp_path, check=False)
    times = decoded(tmp_path / "out.mp4")
    assert times == pytest.approx([frame / rate for frame in range(len(times))])
    assert times[-1] >= 8 - 1 / rate


@pytest.mark.parametrize("frames", [0, 200], ids=["at its end", "while it is written"])
def test_a_full_disk_is_one_line_of_error_and_the_video_is_readable_up_to_there(tmp_path, rng, full, frames):
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
    assert len(decoded(tmp_path / "out.mp4")) >= 50


def test_a_path_that_cannot_be_written_is_an_error_at_once(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(VideoError, match="cannot write the video"):
        VideoWriter(tmp_path / "file" / "out.mp4", 25, (64, 64))


@given(some.lists(some.tuples(some.booleans(), some.sampled_from("abcdefghijkl"))))
def test_a_colour_stays_while_its_object_lives_and_is_shared_only_if_all_are_used(events):
    colours, living = Colours(), {}
    for comes, name in events:
        if comes:
            before = living.setdefault(name, colours.of(name))
            assert colours.of(name) == before
        else:
            living.pop(name, None)
            colours.keep(living)
        assert {name: colours.of(name) for name in living} == living


def test_as_many_objects_as_colours_have_different_ones():
    colours = Colours()
    assert {colours.of(str(number)) for number in range(len(PALETTE))} == {*PALETTE}

"""Annotated video: every frame, any size, whole or not there."""

from __future__ import annotations

from dataclasses import replace

import av
import cv2
import numpy as np
import pytest

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import State, Track
from catstream.video.annotate import Colours, draw, drawn_size, rgb, thumbnail
from catstream.video.source import open_source
from catstream.video.writer import VideoWriter

BOX = Box(40, 30, 60, 40)


def track(state: State = "present", box: Box | None = BOX, frame: int = 7) -> Track:
    return Track(frame + 1, frame, 0.0, state, box, 0.8, 3)


@pytest.mark.parametrize("state", ["bootstrapping", "present", "absent"])
@pytest.mark.parametrize("size", [(640, 480), (320, 240), (1921, 1081)])
def test_drawing_does_not_change_the_frame(state, size):
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    drawn = draw(image, [track(state, None if state == "absent" else BOX)], Colours())
    assert (drawn.shape[1::-1], drawn.shape[2]) == (drawn_size(size), 3)
    assert drawn.shape[1] == size[0]
    assert (image == 128).all()
    assert (drawn[25:35, 35:45] != 128).any() == (state != "absent")
    assert (drawn[size[1] :] != 128).any()


@pytest.mark.parametrize("size", [(70, 50), (352, 288)])
def test_the_text_is_below_the_image(size):
    image = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8)
    assert (draw(image, [track(box=None)], Colours())[: size[1]] == image).all()


@pytest.mark.parametrize(
    "box", [Box(-500, -500, 10, 10), Box(-50, 20, 900, 30), Box(630, 470, 40, 40), Box(5, 5, 0, 0)]
)
def test_boxes_anywhere_can_be_drawn(box):
    assert draw(np.zeros((480, 640, 3), np.uint8), [track(box=box)], Colours()).shape == (506, 640, 3)


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
    red, green, blue = rgb(colour)
    return (image == (blue, green, red)).all(axis=2).sum() > 9


@pytest.mark.parametrize("size", [(70, 50), (352, 288), (1920, 1080)])
@pytest.mark.parametrize("box", [BOX, Box(-50, -50, 900, 3), Box(60, 45, 4, 4), None])
def test_many_objects_with_long_names_can_be_drawn_in_any_picture(size, box):
    tracks = [replace(track(box=box), object=f"{k}-" + 60 * "ë") for k in range(32)]
    assert draw(np.zeros((size[1], size[0], 3), np.uint8), tracks, Colours()).shape[1] == size[0]


@pytest.mark.parametrize("size", [(640, 480), (321, 241), (99, 77)])
def test_the_video_has_each_frame_written_at_any_size(tmp_path, size):
    path = tmp_path / "deep" / "out.mp4"
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    with VideoWriter(path, 29.97, size) as video:
        for _ in range(9):
            video.write(image)
        assert not path.exists()
    with open_source(path) as source:
        assert source.rate == pytest.approx(29.97)
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


@pytest.fixture
def with_sound(tmp_path):
    """A video of 4 s with a tone that begins after 2 s."""
    path = tmp_path / "sound.mp4"
    with av.open(str(path), "w") as container:
        picture, tone = container.add_stream("mpeg4", rate=25), container.add_stream("aac", rate=16000, layout="mono")
        picture.width = picture.height = 64
        picture.pix_fmt = "yuv420p"
        for _ in range(100):
            container.mux(picture.encode(av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), format="bgr24")))
        for start in range(0, 64000, 1000):
            wave = np.sin(np.arange(start, start + 1000) * 0.3) * (start >= 32000)
            samples = av.AudioFrame.from_ndarray(wave[None].astype(np.float32), format="fltp", layout="mono")
            samples.sample_rate, samples.pts = 16000, start
            container.mux(tone.encode(samples))
        container.mux([*picture.encode(None), *tone.encode(None)])
    return path


@pytest.mark.parametrize("first", [0, 25])
def test_the_sound_of_the_source_keeps_its_time(tmp_path, with_sound, first):
    source = open_source(with_sound, part=slice(first, None))
    with source, VideoWriter(tmp_path / "out.mp4", source.rate, source.size, sound=source.sound) as video:
        for frame in source:
            video.write(frame.image, frame.time)
    with av.open(str(tmp_path / "out.mp4")) as container:
        heard = [(frame.time, np.abs(frame.to_ndarray()).max() > 0.5) for frame in container.decode(audio=0)]
    assert min(time for time, loud in heard if loud) == pytest.approx(2 - first / 25, abs=0.15)
    assert heard[-1][0] == pytest.approx(4 - first / 25, abs=0.15)


def test_a_video_without_frames_leaves_no_file(tmp_path):
    with VideoWriter(tmp_path / "out.mp4", 25, (64, 64)):
        pass
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_rendering_leaves_the_video_that_was_there(tmp_path):
    (tmp_path / "out.mp4").write_bytes(b"another")

    def run():
        with VideoWriter(tmp_path / "out.mp4", 25, (64, 64)) as video:
            video.write(np.zeros((64, 64, 3), np.uint8))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"another"]


@pytest.mark.parametrize("frames", [0, 200], ids=["at its end", "while it is written"])
def test_a_full_disk_is_one_line_of_error_and_no_video_is_left(tmp_path, rng, full, frames):
    image = rng.integers(0, 256, (240, 320, 3), np.uint8)  # noise, which no codec makes small

    def run():
        with VideoWriter(tmp_path / "out.mp4", 25, (320, 240)) as video:
            for _ in range(50):  # the encoder keeps some back
                video.write(image)
            full(tmp_path / "out.mp4.part")
            for _ in range(frames):
                video.write(image)

    with pytest.raises(VideoError, match=r"cannot write the video .* any more: No space left on device$"):
        run()
    assert list(tmp_path.iterdir()) == []


def test_a_path_that_cannot_be_written_is_an_error_at_once(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(VideoError, match="cannot write the video"):
        VideoWriter(tmp_path / "file" / "out.mp4", 25, (64, 64))


def test_a_thumbnail_shows_both_boxes():
    image = np.full((200, 400, 3), 128, np.uint8)
    data = thumbnail(image, np.array([40.0, 40, 80, 80]), np.full(4, np.nan), 200)
    small = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert small is not None
    assert small.shape == (100, 200, 3)
    assert small[40, 20].mean() > 180
    assert abs(small[80, 150].astype(int) - 128).max() < 10

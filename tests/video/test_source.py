"""Sources: all good frames in order, and an error that says what is wrong."""

from __future__ import annotations

import gc
import io
import os
import struct
import tempfile
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition

from catstream.errors import VideoError
from catstream.video.frames import Source, UprightConverter
from catstream.video.source import open_source

H264 = dict.fromkeys((".mp4", ".mkv", ".ts", ".mov", ".h264", ".flv", ".MTS"), "libx264")
CODECS = {**H264, ".avi": "mjpeg", ".mpg": "mpeg2video", ".wmv": "wmv2"}


@cache
def numbered(number: int, width: int = 160, height: int = 120) -> np.ndarray:
    """Seven bits of the number as black and white fields, which survive lossy coding, over noise of its own."""
    image = np.random.default_rng(number).integers(60, 190, (height, width, 3), np.uint8)
    for bit in range(7):
        image[4:20, 4 + 20 * bit : 20 + 20 * bit] = 255 if number >> bit & 1 else 0
    return image


def number_of(image: np.ndarray) -> int:
    """The number that `numbered` wrote."""
    return sum((int(image[8:16, 8 + 20 * bit : 16 + 20 * bit].mean() > 127) << bit) for bit in range(7))


@cache
def encoded(
    suffix: str,
    frames: int = 100,
    options: tuple[tuple[str, str], ...] = (),
    rotation: int = 0,
    times: tuple[float, ...] = (),
    sound: float = 0.0,
    title: str = "",
) -> bytes:
    """A file of numbered frames, which many tests read.

    options  of the container, and with the prefix v: of the codec
    times    time stamps of the frames in seconds; empty for 25 frames per second
    sound    seconds of a sound track
    """
    with tempfile.TemporaryDirectory() as folder:
        path, codec = Path(folder, f"a{suffix}"), CODECS[suffix]
        # The same bytes in each run: Matroska has random identifiers, x264's macroblock tree is chaotic.
        muxing = {"fflags": "bitexact", "cluster_time_limit": "400"}  # a long Matroska has many clusters
        coding = {"preset": "superfast"} if codec == "libx264" else {}
        for key, value in options:
            (coding if key.startswith("v:") else muxing)[key.removeprefix("v:")] = value
        with av.open(str(path), "w", options=muxing) as container:
            container.metadata["title"] = title
            stream: Any = container.add_stream(codec, rate=25, options=coding)
            stream.width, stream.height = 160, 120
            stream.codec_context.thread_count = 3  # the bytes depend on it
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            tone: Any = container.add_stream("aac", rate=16000, layout="mono") if sound else None
            if rotation:
                stream.set_display_rotation(rotation)
            for number in range(frames):
                frame = av.VideoFrame.from_ndarray(numbered(number), format="bgr24")
                if times:
                    frame.pts, frame.time_base = round(1000 * times[number]), Fraction(1, 1000)
                    stream.codec_context.time_base = frame.time_base
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
            if sound:
                samples = av.AudioFrame.from_ndarray(np.zeros((1, round(16000 * sound)), np.float32), "fltp", "mono")
                samples.sample_rate = 16000
                container.mux([*tone.encode(samples), *tone.encode(None)])
        return path.read_bytes()


@pytest.fixture
def video(tmp_path: Path) -> Callable[..., Path]:
    """Writes a video of numbered frames; the ending of its name says which kind."""

    def write(name: str, frames: int = 100, options: dict[str, str] | None = None, **others: Any) -> Path:
        path = tmp_path / name
        codec = CODECS[path.suffix]
        if codec not in av.codecs_available:
            pytest.skip(f"this FFmpeg cannot write {codec}")
        path.write_bytes(encoded(path.suffix, frames, tuple((options or {}).items()), **others))
        return path

    return write


def damaged(path: Path, share: float) -> Path:
    """The video with a twentieth of its bytes overwritten, from a share of it on."""
    data = bytearray(path.read_bytes())
    start, count = int(share * len(data)), len(data) // 20
    data[start : start + count] = np.random.default_rng(0).integers(0, 256, count, np.uint8).tobytes()
    path.write_bytes(data)
    return path


@pytest.fixture
def images(tmp_path: Path) -> Callable[..., Path]:
    """Writes numbered images into a folder: by name in the order given, or so many, 0.png and so on."""

    def write(folder: str, names: list[str] | int) -> Path:
        path = tmp_path / folder
        for number, name in enumerate([f"{k}.png" for k in range(names)] if isinstance(names, int) else names):
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(cv2.imencode(Path(name).suffix, numbered(number))[1].tobytes())
        return path

    return write


KINDS = pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts", "a.avi", "a.mpg"])


def numbers(source: Source) -> list[int]:
    with source:
        return [number_of(frame.image) for frame in source]


def broken(path, start: int = 0) -> tuple[list[int], str]:
    """Numbers of the good frames of a broken source, and the error after them."""
    source, good = open_source(path, start), []
    try:
        for frame in source:
            good.append(number_of(frame.image))
    except VideoError as error:
        return good, str(error)
    pytest.fail(f"no error after {len(good)} frames")


# --- videos ------------------------------------------------------------------------------------------


@KINDS
def test_every_frame_of_a_video_is_returned_once_in_order_with_its_number_and_time(video, name):
    path = video(name)
    with open_source(path) as source:
        assert (source.name, source.size, source.rate, source.live) == ("a", (160, 120), 25.0, False)
        assert source.frames == 100
        found = [(frame.number, frame.time, number_of(frame.image)) for frame in source]
    assert found == [(number, pytest.approx(number / 25, abs=0.002), number) for number in range(100)]
    with open_source(path, start=37) as source:
        assert [(frame.number, frame.time, number_of(frame.image)) for frame in source] == found[37:]


PARTS = [slice(7, 31, 3), slice(90, None), slice(None, 200, 11)]


@pytest.mark.parametrize("part", PARTS, ids=str)
@pytest.mark.parametrize("name", ["a.mp4", "a.mpg"])
def test_frames_of_a_part_keep_their_time_stamps(video, name, part):
    wanted = range(100)[part]
    with open_source(video(name), part=part) as source:
        assert source.frames in (len(wanted), None)
        assert source.rate == 25 / wanted.step
        frames = list(source)
    assert [number_of(frame.image) for frame in frames] == list(wanted)
    assert [frame.number for frame in frames] == list(range(len(wanted)))
    assert [frame.time for frame in frames] == pytest.approx([number / 25 for number in wanted], abs=0.002)


def test_damage_after_a_part_is_no_error(video):
    path = damaged(video("a.mpg"), 0.5)
    good, _ = broken(path)
    assert numbers(open_source(path, part=slice(5, len(good)))) == good[5:]


@KINDS
@pytest.mark.parametrize("share", [0.31, 0.6, 0.83])
def test_a_truncated_video_returns_its_good_frames_in_order(video, name, share):
    path = video(name, options={"movflags": "faststart"} if name.endswith("mp4") else None)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    found = numbers(open_source(path, skip_damaged=True))
    assert found == sorted(set(found))
    assert found[:3] == [0, 1, 2]
    assert found[-1] < 99


@pytest.mark.parametrize("name", ["a.mp4", "a.mpg"])
def test_what_ffmpeg_cannot_decode_is_an_error_after_the_frames_before_it(video, name):
    path = damaged(video(name), 0.5)
    good, message = broken(path)
    assert good == list(range(len(good)))
    assert 20 < len(good) < 80
    assert f"{str(path)!r} is damaged at frame {len(good)} (" in message
    assert "\n" not in message


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi", "a.mpg"])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_skip_damaged_continues_at_the_next_keyframe_and_frames_keep_their_times(video, name, share):
    path = damaged(video(name, options={"v:g": "10"}), share)
    with open_source(path, skip_damaged=True) as source:
        found = [(frame.number, frame.time, number_of(frame.image)) for frame in source]
        lost = source.counters.get("damaged", 0)
    shown = [number for _, _, number in found]
    assert [number for number, _, _ in found] == list(range(len(found)))
    assert shown == sorted(set(shown))
    assert (shown[0], shown[-1]) == (0, 99)
    assert lost <= 100 - len(shown) + 1 < 40  # a container may pass over a damaged place without a word
    if path.suffix != ".avi":  # which counts frames in the place of times
        assert [time for _, time, _ in found] == pytest.approx([number / 25 for number in shown], abs=0.002)
    with open_source(path, 20, skip_damaged=True) as source:
        assert [(frame.number, frame.time, number_of(frame.image)) for frame in source] == found[20:]


#: Whole files that something is unusual about: the name, and what `video` is given for it.
LATE = tuple(5 + number / 25 for number in range(60))
WHOLE: dict[str, tuple[str, dict[str, Any]]] = {
    "sound outlasts the picture": ("a.mp4", {"sound": 9.0}),
    "the video begins late": ("a.mkv", {"times": LATE}),
    "frames that repeat the last one": ("a.avi", {"times": tuple(n / 25 if n < 30 else n / 25 + 1 for n in range(60))}),
    "B-frames in an AVI": ("b.avi", {"options": {"v:bf": "3"}}),
    "a title that is not UTF-8": ("a.mkv", {"title": "XXXXXXXX"}),
    "a name that is not UTF-8": (os.fsdecode(b"caf\xe9.mp4"), {}),
    "a suffix of a camcorder": ("00001.MTS", {}),
}


@pytest.mark.parametrize(("name", "others"), WHOLE.values(), ids=WHOLE)
def test_a_whole_file_is_read_to_its_last_frame_and_its_times_grow(video, name, others, monkeypatch):
    if name == "b.avi":
        monkeypatch.setitem(CODECS, ".avi", "libx264")
    path = video(name, 60, **others)
    path.write_bytes(path.read_bytes().replace(b"XXXXXXXX", "обработ".encode("cp1251") + b"!"))
    for skip in (False, True):
        with open_source(path, skip_damaged=skip) as source:
            frames = list(source)
            assert not source.counters
            assert source.frames == 60
        assert [number_of(frame.image) for frame in frames] == list(range(60))
        wanted = np.subtract(others.get("times", LATE), others.get("times", LATE)[0])
        assert [frame.time for frame in frames] == pytest.approx(wanted, abs=0.002)


def test_the_seconds_that_a_truncated_matroska_file_lacks_are_counted(video):
    path = video("a.mkv", 100, sound=4.0)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    for part, lacks in ((slice(None), True), (slice(0, 5), False)):
        with open_source(path, part=part) as source:
            last = [frame.time for frame in source][-1]
            assert source.counters.get("truncated", 0) == (round(4 - last) if lacks else 0)


@pytest.mark.parametrize("name", ["joined.ts", "list.m3u8"])
def test_joined_segments_are_read_to_the_end_and_time_goes_on(video, tmp_path, name):
    part = video("part.ts", 30, options={"v:bf": "2"})
    (tmp_path / "joined.ts").write_bytes(3 * part.read_bytes())
    (tmp_path / "list.m3u8").write_text(
        "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:2\n"
        + "#EXT-X-DISCONTINUITY\n".join(3 * ["#EXTINF:1.2,\npart.ts\n"])
        + "#EXT-X-ENDLIST\n"
    )
    with open_source(tmp_path / name) as source:
        found = [(number_of(frame.image), frame.time) for frame in source]
    assert [number for number, _ in found] == 3 * list(range(30))
    assert [time for _, time in found] == pytest.approx([number / 25 for number in range(90)], abs=0.002)


def test_a_stream_without_a_container_has_the_rate_that_it_states(video):
    path = video("a.h264", 20, options={"v:x264-params": "fps=50/1:force-cfr=1"})
    with open_source(path) as source:
        assert source.rate == pytest.approx(50)
        assert [frame.time for frame in source] == pytest.approx([number / 50 for number in range(20)])


def test_a_video_that_changes_its_size_ends_there_or_is_scaled(video, tmp_path):
    large = tmp_path / "large.ts"
    with av.open(str(large), "w") as container:
        stream: Any = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for number in range(30, 40):
            image = cv2.resize(numbered(number), (320, 240))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    path = video("a.ts", 30)
    path.write_bytes(path.read_bytes() + large.read_bytes())
    good, message = broken(path)
    assert (good, "(frame 30) is 320x240, the first 160x120" in message) == (list(range(30)), True)
    source = open_source(path, resize=True)
    assert numbers(source) == list(range(40))
    assert source.counters == {"scaled": 10}


def without_pictures(data: bytes) -> bytes:
    first, last = data.index(b"mdat") + 4, data.index(b"moov") - 4
    return data[:first] + bytes(last - first) + data[last:]


#: What becomes of a file of 5 frames, how it is opened, and the error.
UNUSABLE: dict[str, tuple[Callable[[bytes], bytes], dict[str, Any], str]] = {
    "without an index": (lambda data: data[: data.index(b"moov")], {}, "not a video that can be read"),
    "without pictures": (without_pictures, {"skip_damaged": True}, "no frame of a can be decoded"),
    "a start after the end": (bytes, {"start": 5}, r"the first frame, 5, is after the end of .* \(5 frames\)"),
    "an unknown device": (bytes, {"hwaccel": "abacus"}, "run.hwaccel=abacus cannot decode .*omit it .*choose one of"),
}


@pytest.mark.parametrize(("changed", "options", "message"), UNUSABLE.values(), ids=UNUSABLE)
def test_a_video_that_cannot_be_used_is_an_error_with_its_reason(video, changed, options, message):
    path = video("a.mp4", frames=5)
    path.write_bytes(changed(path.read_bytes()))
    with pytest.raises(VideoError, match=message):
        open_source(path, **options)


#: Directions on the screen of the axes of the stored picture, and what is seen of an array.
DISPLAYED: dict[str, tuple[tuple[int, ...], Callable[[np.ndarray], np.ndarray]]] = {
    "turned left": ((0, -1, 1, 0), np.rot90),
    "turned right": ((0, 1, -1, 0), lambda stored: np.rot90(stored, -1)),
    "upside down": ((-1, 0, 0, -1), lambda stored: stored[::-1, ::-1]),
    "mirrored": ((-1, 0, 0, 1), lambda stored: stored[:, ::-1]),
    "mirrored and upside down": ((1, 0, 0, -1), lambda stored: stored[::-1]),
    "mirrored and turned": ((0, 1, 1, 0), lambda stored: stored.swapaxes(0, 1)),
    "without directions": ((0, 0, 0, 0), lambda stored: stored),
}


def test_a_frame_is_freed_without_a_garbage_collection(video):
    with av.open(str(video("a.mp4", frames=1))) as container:
        decoded = next(container.decode(video=0))
    upright = UprightConverter()
    gc.collect()
    upright(decoded)
    del decoded
    assert gc.collect() == 0


@pytest.mark.parametrize(("matrix", "seen"), DISPLAYED.values(), ids=DISPLAYED)
def test_videos_are_turned_and_mirrored_as_their_display_matrix_says(video, matrix, seen):
    path = video("a.mp4", frames=1)
    with open_source(path) as source:
        stored = next(source).image
    data, (a, b, c, d) = path.read_bytes(), (65536 * each for each in matrix)
    place = data.index(b"tkhd") + 44
    path.write_bytes(data[:place] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + data[place + 36 :])
    with open_source(path) as source:
        image = next(source).image
    np.testing.assert_array_equal(image, seen(stored))
    assert image.flags.c_contiguous
    assert source.size == image.shape[1::-1]


def test_a_jpeg_picture_with_exif_data_is_read():
    image = np.full((48, 64, 3), 90, np.uint8)
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x0f\0\x02\0\0\0\x04cam\0\0\0\0\0"  # the maker is "cam"
    marked = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2) + exif + jpeg[2:]
    with av.open(io.BytesIO(marked), format="mjpeg") as container:
        (frame,) = container.decode(video=0)
    assert np.abs(UprightConverter()(frame).astype(int) - image).max() <= 2


def test_the_aspect_of_pixels_is_that_of_the_frame_as_it_is_turned(tmp_path):
    for rotation in (0, 90):
        with av.open(str(tmp_path / "a.mp4"), "w") as container:
            stream: Any = container.add_stream("mpeg4", rate=25)
            stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
            stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
            stream.set_display_rotation(rotation)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(numbered(0), format="bgr24")))
            container.mux(stream.encode(None))
        with open_source(tmp_path / "a.mp4") as source:
            assert source.pixel_aspect == (Fraction(3, 4) if rotation else Fraction(4, 3))


def test_a_closed_source_has_no_frames(video):
    source = open_source(video("a.avi", frames=5))
    next(source)
    source.close()
    assert list(source) == []
    source.close()


# --- images ------------------------------------------------------------------------------------------

SEVEN = [f"{number:05d}.png" for number in range(7)]
LATIN = os.fsdecode(b"caf\xe9")
#: Names of images, what is opened, and the numbers of the images that are read.
OPENED = {
    "in natural order": ([f"{number}.png" for number in range(12)], "walk", list(range(12))),
    **{pattern: (SEVEN, f"walk/{pattern}", list(range(7))) for pattern in ("%05d.png", "%d.png", "*.png", "000??.png")},
    "a class of letters": (SEVEN, "walk/0000[2-4].png", [2, 3, 4]),
    "names that match": (["left1.png", "left2.png", "right1.png", "right2.png"], "walk/right%d.png", [2, 3]),
    **{
        inner: ([f"{inner}/1.jpg", f"{inner}/2.jpg", "else/3.jpg"], "walk", [0, 1]) for inner in ("img", "color", "rgb")
    },
    "without hidden files": ([".0000.png", "0001.png"], "walk", [1]),
    "digits that are not decimal": (["²2.png", "²10.png"], "walk", [0, 1]),
    "the images of a sequence": (["img/1.jpg", "img/2.jpg"], "walk/img", [0, 1]),
    "a pattern in a sequence": (["rgb/1.jpg", "rgb/2.jpg"], "walk/rgb/%d.jpg", [0, 1]),
    "names that are not UTF-8": ([f"{LATIN}/1{LATIN}.png", f"{LATIN}/2{LATIN}.png"], f"walk/{LATIN}", [0, 1]),
}


@pytest.mark.parametrize(("names", "opened", "wanted"), OPENED.values(), ids=OPENED)
def test_the_images_of_a_folder_or_a_pattern_are_read_in_order(images, names, opened, wanted):
    folder = images("walk", names)
    (folder / "note.txt").write_text("not an image")
    with open_source(folder.parent / opened, image_rate=10.0) as source:
        assert (source.frames, source.size, source.rate) == (len(wanted), (160, 120), 10)
        assert source.name == (LATIN if LATIN in opened else "walk")
        frames = list(source)
        assert list(source) == []
    assert [number_of(frame.image) for frame in frames] == wanted
    assert [frame.time for frame in frames] == pytest.approx([number / 10 for number in range(len(wanted))])


def test_a_folder_opens_by_its_only_video(video, tmp_path):
    path = video("a.MTS", frames=2)
    for name in ("._a.avi", "._cover.jpg", "groundtruth_rect.txt"):
        (tmp_path / name).write_bytes(b"no video")
    assert numbers(open_source(tmp_path)) == numbers(open_source(path.as_uri())) == [0, 1]
    video("b.avi", frames=1)
    with pytest.raises(VideoError, match="2 videos"):
        open_source(tmp_path)


HUGE = bytes.fromhex("424d") + bytes(8) + struct.pack("<IIiiHHIIIIII", 54, 40, 40000, 40000, 1, 24, *(0,) * 6)
UNREADABLE = {
    "of another size": (
        cv2.imencode(".png", numbered(3, width=150))[1].tobytes(),
        ["150x120", "160x120", "run.resize=true"],
    ),
    "a text": (b"nothing", ["cannot read the image", "(frame 3): replace or remove it"]),
    "empty": (b"", ["cannot read the image"]),
    "a JPEG that is cut off": (cv2.imencode(".jpg", numbered(3))[1].tobytes()[:-500], ["cannot read the image"]),
    "of more pixels than OpenCV reads": (HUGE, ["cannot read the image"]),
}


@pytest.mark.parametrize(("content", "words"), UNREADABLE.values(), ids=UNREADABLE)
def test_the_first_image_that_cannot_be_used_is_named(images, capfd, content, words):
    folder = images("walk", 5)
    (folder / "3.png").write_bytes(content)
    good, message = broken(folder)
    assert good == [0, 1, 2]
    assert all(word in message for word in ["3.png", *words])
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("part", [slice(None), *PARTS], ids=str)
def test_a_part_of_a_folder_has_its_images_from_any_start(images, part):
    folder, wanted = images("walk", 100), range(100)[part]
    with open_source(folder, start=2, part=part) as source:
        assert source.frames == len(wanted)
        found = [(frame.number, number_of(frame.image)) for frame in source]
    assert found == list(enumerate(wanted))[2:]


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (slice(-1, None), "frames count from 0"),
        (slice(0, 9, 0), "frames count from 0"),
        (slice(5, 5), "must be greater than the start"),
    ],
    ids=str,
)
def test_a_part_without_frames_is_an_error(images, part, message):
    with pytest.raises(VideoError, match=message):
        open_source(images("walk", ["0.png"]), part=part)


def test_a_cover_picture_before_the_video_is_not_the_video(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream, cover = container.add_stream("mpeg4", rate=25), container.add_stream("mjpeg", rate=25)
        cover.disposition = Disposition.attached_pic
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        cover.width, cover.height, cover.pix_fmt = 160, 120, "yuvj420p"
        for each, number in ((stream, 7), (cover, 99)):
            container.mux(each.encode(av.VideoFrame.from_ndarray(numbered(number), format="bgr24")))
        container.mux([*stream.encode(None), *cover.encode(None)])
    data = path.read_bytes()
    track, tags = data.index(b"trak") - 4, data.index(b"udta") - 4
    path.write_bytes(data[:track] + data[tags:] + data[track:tags])
    with open_source(path) as source:
        assert source.frames == 1
        assert numbers(source) == [7]


#: How 0, 1, 2 ... 255 is stored in an image of one channel, or of more than 8 bits.
DEEP: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "8 bits of grey": (".png", lambda grey: grey),
    "16 bits of a thermal camera": (".png", lambda grey: 29500 + 2 * grey.astype(np.uint16)),
    "floats": (".tif", lambda grey: 20 + grey.astype(np.float32) / 64),
    "coloured floats": (".tif", lambda grey: np.dstack([20 + grey / 64] * 3)),
    "floats without a value": (".tif", lambda grey: np.where(grey == 7, np.nan, grey).astype(np.float32)),
}


@pytest.mark.parametrize(("suffix", "stored"), DEEP.values(), ids=DEEP)
def test_images_of_more_than_8_bits_are_scaled_by_the_range_of_the_first_one(tmp_path, suffix, stored):
    first = np.arange(256, dtype=np.uint8).repeat(20).reshape(64, 80)
    for number, grey in enumerate([first, first // 2 + 30, first[::-1]]):
        cv2.imwrite(str(tmp_path / f"{number}{suffix}"), stored(grey))
    for start in (0, 1):
        with open_source(tmp_path, start) as source:
            second = [frame.image for frame in source][1 - start]
        wanted = np.where(first // 2 + 30 == 7, 0, first // 2 + 30)
        np.testing.assert_array_equal(second, np.dstack([wanted] * 3))


def test_all_pages_of_an_image_file_are_read_but_only_the_first_one_in_a_folder(tmp_path, caplog):
    pages = [numbered(number) for number in range(40)]
    animation = cv2.Animation()
    animation.frames, animation.durations = pages, np.full(40, 40, np.int32)
    cv2.imwritemulti(str(tmp_path / "a.tif"), pages)
    for suffix in ("webp", "png", "gif"):
        cv2.imwriteanimation(str(tmp_path / f"a.{suffix}"), animation)
    for suffix in ("tif", "webp", "png", "gif"):
        source = open_source(tmp_path / f"a.{suffix}")
        assert source.frames == 40
        assert numbers(source) == list(range(40))
    assert numbers(open_source(tmp_path / "a.tif", 2, part=slice(30, None, 3))) == [36, 39]
    assert not caplog.messages
    assert numbers(open_source(tmp_path / "*.tif")) == [0]
    assert "a.tif has 40 pages" in caplog.messages[0]


def test_images_before_the_first_frame_are_not_read(images):
    folder = images("walk", 5)
    (folder / "0.png").write_bytes(b"nothing")
    with open_source(folder, 2) as source:
        assert [frame.number for frame in source] == [2, 3, 4]


def test_images_of_another_size_are_scaled_to_the_first_one_also_from_a_later_start(images):
    folder = images("walk", 5)
    cv2.imwrite(str(folder / "3.png"), numbered(3, width=150))
    for start in (0, 3):
        with open_source(folder, start, resize=True) as source:
            assert [frame.image.shape for frame in source] == [(120, 160, 3)] * (5 - start)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("empty", "neither images nor a video"),
        ("missing.mp4", "no video or folder"),
        ("empty/%05d.png", "no images at"),
        ("empty/*.png", "no images at"),
        ("notes.txt", "pass a video file, a folder of images"),
        ("notes.mp4", "pass a video file, a folder of images"),
        ("nothing.mp4", "pass a video file, a folder of images"),
        ("pipe.mpg", r"is a pipe or a device, .* write the video to a file"),
        ("-", "write the video to a file"),
        ("file://elsewhere/walk.mp4", "another machine"),
    ],
)
def test_what_is_no_source_is_an_error_that_names_the_alternatives(tmp_path, monkeypatch, place, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for name, text in (("notes.txt", "not a video\n" * 50), ("notes.mp4", "not a video\n" * 50), ("nothing.mp4", "")):
        (tmp_path / name).write_text(text)
    os.mkfifo(tmp_path / "pipe.mpg")
    with pytest.raises(VideoError, match=message):
        open_source(place)

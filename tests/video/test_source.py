"""Sources: all good frames in order, and an error that says what is wrong."""

from __future__ import annotations

import gc
import io
import os
import struct
from collections.abc import Callable
from fractions import Fraction
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
from tests.video import pictures
from tests.video.pictures import damaged, make_video, number_of, numbered

KINDS = pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts", "a.avi", "a.mpg"])
PARTS = [slice(7, 31, 3), slice(90, None), slice(None, 200, 11)]


def make_images(folder: Path, names: list[str]) -> Path:
    """Write numbered images into a folder, by name in the order given."""
    for number, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(cv2.imencode(Path(name).suffix, numbered(number))[1].tobytes())
    return folder


@pytest.fixture
def five(tmp_path: Path) -> Path:
    """A folder of five images."""
    return make_images(tmp_path / "walk", [f"{number}.png" for number in range(5)])


def read(source: Source) -> list[tuple[int, float, int]]:
    """The number and the time of each frame, and the number that it shows."""
    with source:
        return [(frame.number, frame.time, number_of(frame.image)) for frame in source]


def shown(source: Source) -> list[int]:
    return [number for *_, number in read(source)]


def broken(path: Path) -> tuple[list[int], str]:
    """Numbers of the good frames of a broken source, and the error after them."""
    source, good = open_source(path), []
    try:
        for frame in source:
            good.append(number_of(frame.image))
    except VideoError as error:
        return good, str(error)
    pytest.fail(f"no error after {len(good)} frames")


# --- videos ------------------------------------------------------------------------------------------


@KINDS
def test_video_has_every_frame_once_in_order(tmp_path, name):
    path = make_video(tmp_path / name)
    with open_source(path) as source:
        assert (source.name, source.size, source.rate, source.live) == ("a", (160, 120), 25.0, False)
        assert source.frames == 100
        frames = read(source)
    assert frames == [(number, pytest.approx(number / 25, abs=0.002), number) for number in range(100)]
    assert read(open_source(path, start=37)) == frames[37:]


@pytest.mark.parametrize("part", PARTS, ids=str)
@pytest.mark.parametrize("name", ["a.mp4", "a.mpg"])
def test_frames_of_a_part_keep_their_time_stamps(tmp_path, name, part):
    wanted = range(100)[part]
    source = open_source(make_video(tmp_path / name), part=part)
    assert source.frames in (len(wanted), None)
    assert source.rate == 25 / wanted.step
    expected = [(place, pytest.approx(number / 25, abs=0.002), number) for place, number in enumerate(wanted)]
    assert read(source) == expected


def test_damage_after_a_part_is_no_error(tmp_path):
    path = damaged(make_video(tmp_path / "a.mpg"), 0.5)
    good, _ = broken(path)
    assert shown(open_source(path, part=slice(5, len(good)))) == good[5:]


@KINDS
@pytest.mark.parametrize("share", [0.31, 0.6, 0.83])
def test_truncated_video_has_its_good_frames_in_order(tmp_path, name, share):
    path = make_video(tmp_path / name, options={"movflags": "faststart"} if name.endswith("mp4") else None)
    os.truncate(path, int(path.stat().st_size * share))
    numbers = shown(open_source(path, skip_damaged=True))
    assert numbers == sorted(set(numbers))
    assert numbers[:3] == [0, 1, 2]
    assert numbers[-1] < 99


@pytest.mark.parametrize("name", ["a.mp4", "a.mpg"])
def test_damage_is_an_error_after_the_frames_before_it(tmp_path, name):
    path = damaged(make_video(tmp_path / name), 0.5)
    good, message = broken(path)
    assert good == list(range(len(good)))
    assert 20 < len(good) < 80
    assert f"{str(path)!r} is damaged at frame {len(good)} (" in message
    assert "\n" not in message


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi", "a.mpg"])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_skip_damaged_continues_at_the_next_keyframe(tmp_path, name, share):
    path = damaged(make_video(tmp_path / name, options={"v:g": "10"}), share)
    source = open_source(path, skip_damaged=True)
    frames = read(source)
    numbers, times, seen = zip(*frames, strict=True)
    assert list(numbers) == list(range(len(frames)))
    assert list(seen) == sorted(set(seen))
    assert (seen[0], seen[-1]) == (0, 99)
    # A container may pass over a damaged place without a word.
    assert source.counters.get("damaged", 0) <= 100 - len(seen) + 1 < 40
    if path.suffix != ".avi":  # which counts frames in the place of times
        assert times == pytest.approx([number / 25 for number in seen], abs=0.002)
    assert read(open_source(path, 20, skip_damaged=True)) == frames[20:]


#: Whole files with an unusual property: their name, and how they are made.
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
def test_unusual_file_is_read_to_its_last_frame(tmp_path, name, others, monkeypatch):
    if name == "b.avi":
        monkeypatch.setitem(pictures.CODECS, ".avi", "libx264")
    path = make_video(tmp_path / name, 60, **others)
    path.write_bytes(path.read_bytes().replace(b"XXXXXXXX", "обработ".encode("cp1251") + b"!"))
    first, *_ = times = others.get("times", LATE)
    for skip in (False, True):
        source = open_source(path, skip_damaged=skip)
        assert source.frames == 60
        expected = [(number, pytest.approx(time - first, abs=0.002), number) for number, time in enumerate(times)]
        assert read(source) == expected
        assert not source.counters


def test_missing_seconds_of_a_truncated_matroska_are_counted(tmp_path):
    path = make_video(tmp_path / "a.mkv", sound=4.0)
    os.truncate(path, path.stat().st_size // 2)
    for part, is_truncated in ((slice(None), True), (slice(0, 5), False)):
        source = open_source(path, part=part)
        _, last, _ = read(source)[-1]
        assert source.counters.get("truncated", 0) == (round(4 - last) if is_truncated else 0)


@pytest.mark.parametrize("name", ["joined.ts", "list.m3u8"])
def test_joined_segments_are_read_to_the_end(tmp_path, name):
    part = make_video(tmp_path / "part.ts", 30, {"v:bf": "2"})
    (tmp_path / "joined.ts").write_bytes(3 * part.read_bytes())
    (tmp_path / "list.m3u8").write_text(
        "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:2\n"
        + "#EXT-X-DISCONTINUITY\n".join(3 * ["#EXTINF:1.2,\npart.ts\n"])
        + "#EXT-X-ENDLIST\n"
    )
    expected = [(number, pytest.approx(number / 25, abs=0.002), number % 30) for number in range(90)]
    assert read(open_source(tmp_path / name)) == expected


def test_raw_h264_has_the_rate_of_its_header(tmp_path):
    path = make_video(tmp_path / "a.h264", 20, {"v:x264-params": "fps=50/1:force-cfr=1"})
    with open_source(path) as source:
        assert source.rate == pytest.approx(50)
        assert [frame.time for frame in source] == pytest.approx([number / 50 for number in range(20)])


def test_changed_size_is_an_error_or_scaled(tmp_path):
    path, large = make_video(tmp_path / "a.ts", 30), make_video(tmp_path / "large.ts", 10, size=(320, 240))
    path.write_bytes(path.read_bytes() + large.read_bytes())
    good, message = broken(path)
    assert (good, "(frame 30) is 320x240, the first 160x120" in message) == (list(range(30)), True)
    source = open_source(path, resize=True)
    assert shown(source) == [*range(30), *range(10)]
    assert source.counters == {"scaled": 10}


def without_pictures(data: bytes) -> bytes:
    first, last = data.index(b"mdat") + 4, data.index(b"moov") - 4
    return data[:first] + bytes(last - first) + data[last:]


#: A change to a file of 5 frames, how it is opened, and the error.
UNUSABLE: dict[str, tuple[Callable[[bytes], bytes], dict[str, Any], str]] = {
    "without an index": (lambda data: data[: data.index(b"moov")], {}, "not a video that can be read"),
    "without pictures": (without_pictures, {"skip_damaged": True}, "no frame of a can be decoded"),
    "a start after the end": (bytes, {"start": 5}, r"the first frame, 5, is after the end of .* \(5 frames\)"),
    "an unknown device": (bytes, {"hwaccel": "abacus"}, "run.hwaccel=abacus cannot decode .*omit it .*choose one of"),
}


@pytest.mark.parametrize(("changed", "options", "message"), UNUSABLE.values(), ids=UNUSABLE)
def test_unusable_video_is_an_error_with_its_reason(tmp_path, changed, options, message):
    path = make_video(tmp_path / "a.mp4", 5)
    path.write_bytes(changed(path.read_bytes()))
    with pytest.raises(VideoError, match=message):
        open_source(path, **options)


def test_frame_is_freed_without_garbage_collection(tmp_path):
    with av.open(str(make_video(tmp_path / "a.mp4", 1))) as container:
        decoded = next(container.decode(video=0))
    upright = UprightConverter()
    gc.collect()
    upright(decoded)
    del decoded
    assert gc.collect() == 0


#: Directions on the screen of the axes of the stored picture, and the view of an array.
DISPLAYED: dict[str, tuple[tuple[int, ...], Callable[[np.ndarray], np.ndarray]]] = {
    "turned left": ((0, -1, 1, 0), np.rot90),
    "turned right": ((0, 1, -1, 0), lambda stored: np.rot90(stored, -1)),
    "upside down": ((-1, 0, 0, -1), lambda stored: stored[::-1, ::-1]),
    "mirrored": ((-1, 0, 0, 1), lambda stored: stored[:, ::-1]),
    "mirrored and upside down": ((1, 0, 0, -1), lambda stored: stored[::-1]),
    "mirrored and turned": ((0, 1, 1, 0), lambda stored: stored.swapaxes(0, 1)),
    "without directions": ((0, 0, 0, 0), lambda stored: stored),
}


@pytest.mark.parametrize(("matrix", "view"), DISPLAYED.values(), ids=DISPLAYED)
def test_display_matrix_turns_and_mirrors_frames(tmp_path, matrix, view):
    path = make_video(tmp_path / "a.mp4", 1)
    with open_source(path) as source:
        stored = next(source).image
    data, (a, b, c, d) = path.read_bytes(), (65536 * each for each in matrix)
    place = data.index(b"tkhd") + 44
    path.write_bytes(data[:place] + struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30) + data[place + 36 :])
    with open_source(path) as source:
        image = next(source).image
    np.testing.assert_array_equal(image, view(stored))
    assert image.flags.c_contiguous
    assert source.size == image.shape[1::-1]


def test_jpeg_with_exif_data_is_read():
    image = np.full((48, 64, 3), 90, np.uint8)
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x0f\0\x02\0\0\0\x04cam\0\0\0\0\0"  # the maker is "cam"
    marked = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2) + exif + jpeg[2:]
    with av.open(io.BytesIO(marked), format="mjpeg") as container:
        (frame,) = container.decode(video=0)
    assert np.abs(UprightConverter()(frame).astype(int) - image).max() <= 2


@pytest.mark.parametrize(("rotation", "aspect"), [(0, Fraction(4, 3)), (90, Fraction(3, 4))])
def test_pixel_aspect_is_rotated_with_the_frame(tmp_path, rotation, aspect):
    path = make_video(tmp_path / "a.mp4", 1, aspect=Fraction(4, 3), rotation=rotation)
    with open_source(path) as source:
        assert source.pixel_aspect == aspect


def test_closed_source_has_no_frames(tmp_path):
    source = open_source(make_video(tmp_path / "a.avi", 5))
    next(source)
    source.close()
    assert list(source) == []
    source.close()


def test_cover_picture_is_not_the_video(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream, cover = container.add_stream("mpeg4", rate=25), container.add_stream("mjpeg", rate=25)
        cover.disposition = Disposition.attached_pic
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        cover.width, cover.height, cover.pix_fmt = 160, 120, "yuvj420p"
        for each, number in ((stream, 7), (cover, 99)):
            container.mux(each.encode(av.VideoFrame.from_ndarray(numbered(number), format="bgr24")))
        container.mux([*stream.encode(None), *cover.encode(None)])
    data = path.read_bytes()  # the cover is moved before the video
    track, tags = data.index(b"trak") - 4, data.index(b"udta") - 4
    path.write_bytes(data[:track] + data[tags:] + data[track:tags])
    source = open_source(path)
    assert source.frames == 1
    assert shown(source) == [7]


# --- images ------------------------------------------------------------------------------------------

SEVEN = [f"{number:05d}.png" for number in range(7)]
LATIN = os.fsdecode(b"caf\xe9")
#: Names of images, the path to open, and the numbers of the images that are read.
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


@pytest.mark.parametrize(("names", "path", "wanted"), OPENED.values(), ids=OPENED)
def test_images_of_a_folder_or_pattern_are_read_in_order(tmp_path, names, path, wanted):
    (make_images(tmp_path / "walk", names) / "note.txt").write_text("not an image")
    with open_source(tmp_path / path, image_rate=10.0) as source:
        assert (source.frames, source.size, source.rate) == (len(wanted), (160, 120), 10)
        assert source.name == (LATIN if LATIN in path else "walk")
        assert read(source) == [(place, pytest.approx(place / 10), number) for place, number in enumerate(wanted)]
        assert list(source) == []


def test_folder_opens_by_its_only_video(tmp_path):
    path = make_video(tmp_path / "a.MTS", 2)
    for name in ("._a.avi", "._cover.jpg", "groundtruth_rect.txt"):
        (tmp_path / name).write_bytes(b"no video")
    assert shown(open_source(tmp_path)) == shown(open_source(path.as_uri())) == [0, 1]
    make_video(tmp_path / "b.avi", 1)
    with pytest.raises(VideoError, match="2 videos"):
        open_source(tmp_path)


HUGE = bytes.fromhex("424d") + bytes(8) + struct.pack("<IIiiHHIIIIII", 54, 40, 40000, 40000, 1, 24, *(0,) * 6)
UNREADABLE = {
    "of another size": (cv2.imencode(".png", numbered(3, 150))[1].tobytes(), "150x120, the first 160x120.*run.resize"),
    "a text": (b"nothing", r"cannot read the image .*\(frame 3\): replace or remove it"),
    "empty": (b"", "cannot read the image"),
    "a JPEG that is cut off": (cv2.imencode(".jpg", numbered(3))[1].tobytes()[:-500], "cannot read the image"),
    "of more pixels than OpenCV reads": (HUGE, "cannot read the image"),
}


@pytest.mark.parametrize(("content", "message"), UNREADABLE.values(), ids=UNREADABLE)
def test_first_unusable_image_is_named_in_the_error(five, capfd, content, message):
    (five / "3.png").write_bytes(content)
    source = open_source(five)
    assert [number_of(next(source).image) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(VideoError, match=message) as error:
        next(source)
    assert "3.png" in str(error.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("part", [slice(None), *PARTS], ids=str)
def test_part_of_a_folder_is_read_from_any_start(tmp_path, part):
    folder, wanted = make_images(tmp_path / "walk", [f"{number}.png" for number in range(100)]), range(100)[part]
    (folder / f"{wanted[1]}.png").write_bytes(b"nothing")  # an image before the start is not read
    source = open_source(folder, start=2, part=part)
    assert source.frames == len(wanted)
    assert [(number, image) for number, _, image in read(source)] == list(enumerate(wanted))[2:]


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (slice(-1, None), "frames count from 0"),
        (slice(0, 9, 0), "frames count from 0"),
        (slice(5, 5), "must be greater than the start"),
    ],
    ids=str,
)
def test_part_without_frames_is_an_error(five, part, message):
    with pytest.raises(VideoError, match=message):
        open_source(five, part=part)


#: How 0, 1, 2 ... 255 is stored in an image of one channel, or of more than 8 bits.
DEEP: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "8 bits of grey": (".png", lambda grey: grey),
    "16 bits of a thermal camera": (".png", lambda grey: 29500 + 2 * grey.astype(np.uint16)),
    "floats": (".tif", lambda grey: 20 + grey.astype(np.float32) / 64),
    "coloured floats": (".tif", lambda grey: np.dstack([20 + grey / 64] * 3)),
    "floats without a value": (".tif", lambda grey: np.where(grey == 7, np.nan, grey).astype(np.float32)),
}


@pytest.mark.parametrize(("suffix", "stored"), DEEP.values(), ids=DEEP)
def test_deep_images_are_scaled_by_the_range_of_the_first(tmp_path, suffix, stored):
    first = np.arange(256, dtype=np.uint8).repeat(20).reshape(64, 80)
    for number, grey in enumerate([first, first // 2 + 30, first[::-1]]):
        cv2.imwrite(str(tmp_path / f"{number}{suffix}"), stored(grey))
    for start in (0, 1):
        with open_source(tmp_path, start) as source:
            second = [frame.image for frame in source][1 - start]
        wanted = np.where(first // 2 + 30 == 7, 0, first // 2 + 30)
        np.testing.assert_array_equal(second, np.dstack([wanted] * 3))


def test_image_file_has_all_its_pages_but_one_in_a_folder(tmp_path, caplog):
    animation = cv2.Animation()
    animation.frames, animation.durations = [numbered(number) for number in range(40)], np.full(40, 40, np.int32)
    cv2.imwritemulti(str(tmp_path / "a.tif"), animation.frames)
    for suffix in ("webp", "png", "gif"):
        cv2.imwriteanimation(str(tmp_path / f"a.{suffix}"), animation)
    for suffix in ("tif", "webp", "png", "gif"):
        source = open_source(tmp_path / f"a.{suffix}")
        assert source.frames == 40
        assert shown(source) == list(range(40))
    assert shown(open_source(tmp_path / "a.tif", 2, part=slice(30, None, 3))) == [36, 39]
    assert not caplog.messages
    assert shown(open_source(tmp_path / "*.tif")) == [0]
    assert "a.tif has 40 pages" in caplog.messages[0]


@pytest.mark.parametrize("start", [0, 3])
def test_images_of_another_size_are_scaled_to_the_first(five, start):
    cv2.imwrite(str(five / "3.png"), numbered(3, 150))
    with open_source(five, start, resize=True) as source:
        assert [frame.image.shape for frame in source] == [(120, 160, 3)] * (5 - start)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("empty", "neither images nor a video"),
        ("missing.mp4", "no video or folder"),
        ("empty/%05d.png", "no images at"),
        ("empty/*.png", "no images at"),
        ("notes.txt", "pass a video file, a folder of images"),
        ("nothing.mp4", "pass a video file, a folder of images"),
        ("pipe.mpg", r"is a pipe or a device, .* write the video to a file"),
        ("-", "write the video to a file"),
        ("file://elsewhere/walk.mp4", "another machine"),
    ],
)
def test_invalid_source_is_an_error_with_the_alternatives(tmp_path, monkeypatch, path, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("not a video\n" * 50)
    (tmp_path / "nothing.mp4").touch()
    os.mkfifo(tmp_path / "pipe.mpg")
    with pytest.raises(VideoError, match=message):
        open_source(path)

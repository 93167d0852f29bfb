"""Which files are searched."""

from __future__ import annotations

import errno
import shutil
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from catstream.applications.finding.find import File, find_files
from catstream.errors import VideoError
from catstream.settings import RunSettings


@pytest.fixture
def tree(tmp_path, video):
    """A folder with videos, images and other files."""
    for place in ("clips/a.mp4", "clips/deep/b.MP4"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(video, tmp_path / place)
    (tmp_path / "photos").mkdir()
    for number in (10, 9, 1):
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), np.full((20 + number, 30, 3), number, np.uint8))
    (tmp_path / "photos" / "notes.txt").write_text("no picture")
    (tmp_path / ".hidden").mkdir()
    shutil.copy(video, tmp_path / ".hidden" / "c.mp4")
    return tmp_path


def frames(file):
    problems = []
    searched = file.frames(0.0, RunSettings(), lambda _: None, problems.append)
    return [(frame.number, name, frame.image.shape) for frame, name in searched], problems


def test_folders_are_searched_with_their_subfolders_and_each_file_once(tree):
    found = find_files([tree, tree / "clips" / "a.mp4"])
    kinds = [(str(file.path.relative_to(tree)), file.kind) for file in found]
    assert kinds == [("clips/a.mp4", "video"), ("clips/deep/b.MP4", "video"), ("photos", "images")]


def test_a_subfolder_that_may_not_be_read_is_reported_and_the_others_are_searched(tree, monkeypatch, caplog):
    listed = type(tree).iterdir

    def iterdir(folder):
        if folder.name == "deep":
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return listed(folder)

    monkeypatch.setattr(type(tree), "iterdir", iterdir)
    assert [file.path.name for file in find_files([tree])] == ["a.mp4", "photos"]
    assert f"{tree / 'clips' / 'deep'} is left out (Permission denied)" in caplog.messages


def test_linked_folders_are_searched_once_and_what_is_left_out_is_told(tree, tmp_path_factory, caplog):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    for name in ("c.m2ts", "d.heic", "e.heic", "f"):
        shutil.copy(tree / "clips" / "a.mp4", elsewhere / name)
    for link, to in (("linked", elsewhere), ("loop", tree), ("again", elsewhere), ("dead", tree / "gone")):
        (tree / link).symlink_to(to)
    found = [str(file.path.relative_to(tree)) for file in find_files([tree])]
    assert found == ["again/c.m2ts", "clips/a.mp4", "clips/deep/b.MP4", "photos"]
    assert "2 .heic, 2 without a suffix, 1 .txt" in caplog.text


def test_images_of_a_folder_come_in_natural_order_and_may_differ_in_size(tree):
    found, problems = frames(File(tree / "photos", "images"))
    assert found == [(0, "1.png", (21, 30, 3)), (1, "9.png", (29, 30, 3)), (2, "10.png", (30, 30, 3))]
    assert not problems


def test_images_that_are_unreadable_or_gone_are_reported_and_the_others_are_read(tree):
    (tree / "photos" / "9.png").write_bytes(b"no picture")
    (tree / "photos" / "8.png").symlink_to("gone.png")
    file = File(tree / "photos", "images")
    assert file.signature[0] == 3
    found, (gone, unreadable) = frames(file)
    assert [name for _, name, _ in found] == ["1.png", "10.png"]
    assert "8.png" in gone
    assert "9.png" in unreadable


def test_a_single_image_has_a_frame_for_each_page(tree):
    cv2.imwritemulti(str(tree / "a.tif"), [np.zeros((20, 30 + page), np.uint8) for page in range(3)])
    one, several = find_files([tree / "photos" / "10.png", tree / "a.tif"])
    assert frames(one)[0] == [(0, "", (30, 30, 3))]
    assert frames(several)[0] == [(page, "", (20, 30 + page, 3)) for page in range(3)]


def test_a_video_is_searched_by_time_whatever_its_rate_and_its_size_may_change(tmp_path, caplog):
    times = [0.0, 0.01, 0.05, 0.19, 0.2, 0.31, 0.6, 0.61, 3.0, 3.01]
    for name, width in (("a.ts", 160), ("b.ts", 320)):
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream("mpeg4", rate=25)
            stream.width, stream.height, stream.pix_fmt = width, 120, "yuv420p"
            stream.codec_context.time_base = Fraction(1, 1000)
            for time in times:
                frame = av.VideoFrame(width, 120, "yuv420p")
                frame.pts, frame.time_base = round(1000 * time), Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    joined = tmp_path / "joined.ts"
    joined.write_bytes((tmp_path / "a.ts").read_bytes() + (tmp_path / "b.ts").read_bytes())
    problems = []
    steps = File(joined, "video").frames(0.2, RunSettings(), lambda _: None, problems.append)
    assert [frame.number for frame, _ in steps] == [0, 4, 6, 8, 13, 16, 18, 19]
    assert not problems
    assert "10 frames of another size" in caplog.text


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.mp4", "no file or folder"),
        ("empty", "neither images nor videos: "),
        ("texts", r"neither images nor videos \(1 \.txt\)"),
        ("0", "live"),
        ("rtsp://a:b@c/d", "rtsp://c/d is a live"),
    ],
)
def test_what_cannot_be_searched_is_an_error(tmp_path, name, message, monkeypatch):
    (tmp_path / "empty").mkdir()
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "a.txt").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VideoError, match=message):
        find_files([name])

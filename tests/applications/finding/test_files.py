"""Which files are searched."""

import errno
import shutil

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
    assert caplog.messages == [f"{tree / 'clips' / 'deep'} is left out (Permission denied)"]


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


def test_a_single_image_is_one_frame(tree):
    (file,) = find_files([tree / "photos" / "10.png"])
    assert frames(file)[0] == [(0, "", (30, 30, 3))]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.mp4", "no file or folder"),
        ("empty", "neither images nor videos"),
        ("0", "live"),
        ("rtsp://a:b@c/d", "rtsp://c/d is a live"),
    ],
)
def test_what_cannot_be_searched_is_an_error(tmp_path, name, message, monkeypatch):
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VideoError, match=message):
        find_files([name])

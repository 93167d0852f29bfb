"""`catstream.summarize`: images of all sizes, from arrays and files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from catstream import summarize
from catstream.applications.summaries.collection import Collection
from catstream.applications.summaries.images import describe
from catstream.errors import FrameError, SettingsError, VideoError


def test_images_of_different_sizes_are_summarised(photographs):
    found = summarize(iter(photographs), k=6)
    assert len(set(found.selected)) == 6
    assert found.count == len(photographs)
    assert 0.5 < found.kept <= found.kept_at_most <= 1
    assert found.kept == pytest.approx(sum(found.energies))


def test_the_same_images_give_the_same_summary_as_arrays_and_as_files(photographs, tmp_path):
    files = [tmp_path / f"{number}.png" for number in range(10)]
    for file, image in zip(files, photographs, strict=False):
        cv2.imwrite(str(file), image)
    assert summarize(files, 3) == summarize(map(str, files), 3) == summarize(photographs[:10], 3)


def test_a_row_changes_little_with_the_size_of_the_image(photographs):
    for image, other in zip(photographs[:10:2], photographs[1:10:2], strict=True):
        row, smaller = describe(image), describe(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        assert np.linalg.norm(row - smaller) < 0.3 * np.linalg.norm(row - describe(other))


@pytest.mark.parametrize("path", [str, Path])
def test_one_path_in_place_of_an_iterable_is_an_error_with_the_remedy(path, tmp_path):
    with pytest.raises(VideoError, match=r"got the path .*: give a list of files"):
        summarize(path(tmp_path), k=1)


def test_invalid_input_is_an_error_of_one_line(photographs, tmp_path):
    (tmp_path / "torn.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(VideoError, match=r"cannot read the image '.*torn.jpg': replace it, or leave it out"):
        summarize([tmp_path / "torn.jpg"], 1)
    with pytest.raises(FrameError, match="got None"):
        summarize([photographs[0], None], 1)
    with pytest.raises(SettingsError, match="k = 3 images cannot be selected from 2"):
        summarize(photographs[:2], 3)


def test_a_folder_is_read_in_natural_order_and_damaged_images_are_named(folder):
    collection = Collection(folder)
    names = [origin.file for origin, _ in collection]
    assert names == [f"a/{number}.jpg" for number in (0, 1, 2, 3, 5)] + [f"b/{number}.jpg" for number in range(6, 12)]
    assert collection.skipped == ["a/4.jpg: not an image that can be read"]


def test_every_frame_of_a_video_is_an_image_and_a_file_that_is_no_video_is_named(demo_video, tmp_path):
    path, _ = demo_video(60)
    (tmp_path / "clip.mp4").symlink_to(path)
    (tmp_path / "torn.mp4").write_bytes(b"no video")
    collection = Collection(tmp_path)
    assert [origin.frame for origin, _ in collection] == list(range(60))
    assert len(collection.skipped) == 1
    assert collection.skipped[0].startswith("torn.mp4: ")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("", "hold neither images nor videos"),
        ("gone", "there is no file or folder"),
        ("notes.txt", r"is not a video that can be read \([^:]*\): give a folder of images, or a video file$"),
        ("torn.jpg", "torn.jpg: not an image that can be read: give a folder"),
    ],
)
def test_a_path_without_images_is_an_error_of_one_line(name, problem, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    for file in ("notes.txt", "torn.jpg"):
        (tmp_path / file).write_text("no image")
    with pytest.raises(VideoError, match=problem) as error:
        list(Collection(tmp_path / name if name else folder))
    assert "\n" not in str(error.value)

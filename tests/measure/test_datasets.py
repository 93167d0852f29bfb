"""Sequences: the same ground truth in every layout, and the errors of a malformed one."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from catstream.errors import VideoError
from catstream.measure.datasets import find_sequences

TRUTH = np.array([[10, 20, 30, 40], [12.5, 21, 30, 40], [np.nan] * 4, [15, 22, 31, 41.5]])


def folder(path: Path, name: str, images: str, text: str, frames: int = 4, file: str = "%05d.png") -> Path:
    """A sequence with some frames and a file of ground truth."""
    (path / images).mkdir(parents=True)
    for number in range(1, frames + 1):
        cv2.imwrite(str(path / images / (file % number)), np.full((8, 8, 3), number, np.uint8))
    (path / name).write_text(text)
    return path


def lines(rows: np.ndarray, sign: str = ",") -> str:
    return "".join(sign.join(f"{value:g}" for value in row) + "\n" for row in rows)


def check(path: Path, name: str = "walk") -> None:
    (sequence,) = find_sequences(path)
    assert sequence.name == name
    np.testing.assert_allclose(sequence.boxes, TRUTH)
    assert [int(image[0, 0, 0]) for image in sequence.frames()] == [1, 2, 3, 4]
    assert [int(image[0, 0, 0]) for image in sequence.since(2).frames()] == [3, 4]


X, Y, W, H = TRUTH.T


@pytest.mark.parametrize(
    ("name", "images", "columns", "sign", "file"),
    [
        pytest.param("groundtruth_rect.txt", "img", [X, Y, W, H], "\t", "%04d.jpg", id="OTB"),
        pytest.param("gt.txt", ".", [X, Y, X + W, Y + H], ",", "%05d.png", id="TLD"),
        pytest.param("groundtruth.txt", ".", [X, Y + H, X, Y, X + W, Y, X + W, Y + H], ",", "%08d.jpg", id="VOT"),
        pytest.param("groundtruth.txt", "color", [X, Y, W, H], ",", "%05d.png", id="VOT, rectangles"),
        pytest.param("walk.txt", "rgb", [X, Y, W, H, [1, 0, 0, 0]], ",", "r-%d-1.png", id="Princeton, occlusion"),
    ],
)
def test_layout_of_a_benchmark_is_read(tmp_path, name, images, columns, sign, file):
    sequence = folder(tmp_path / "walk", name, images, lines(np.column_stack(columns), sign), file=file)
    (sequence / "depth").mkdir()  # Princeton's other images
    cv2.imwrite(str(sequence / "depth" / "d-1-1.png"), np.zeros((8, 8), np.uint16))
    check(sequence)


@pytest.mark.parametrize(
    ("file", "text", "absent"),
    [
        ("full_occlusion.txt", "0,0,1,1,0", [2, 3]),  # LaSOT: one line
        ("out_of_view.txt", "0,1,0,0,0\n", [1]),
        ("absence.label", "0\n0\n0\n1\n0\n", [3]),  # GOT-10k: a line for each frame
        ("cover.label", "8\n0\n1\n5\n8\n", [1]),
        ("full-occlusion.tag", "0\n1\n0\n0\n0\n", [1]),  # CDTB
        ("out-of-frame.tag", "0.0\n0.0\n1.0\n0.0\n0.0\n", [2]),
    ],
)
def test_object_is_absent_in_flagged_frames(tmp_path, file, text, absent):
    path = folder(tmp_path / "walk", "groundtruth.txt", "img", "1,2,0,40\n" + 4 * "1,2,30,40\n", frames=5)
    (path / file).write_text(text)
    assert np.flatnonzero(~find_sequences(path)[0].present).tolist() == [0, *absent]


@pytest.mark.parametrize(
    ("text", "message"), [("0,1", "2 numbers for 4 boxes"), ("", "list of numbers"), ("a", "numbers")]
)
def test_flags_that_do_not_fit_the_boxes_are_an_error(tmp_path, text, message):
    path = folder(tmp_path / "walk", "groundtruth.txt", "img", 4 * "1,2,30,40\n")
    (path / "absence.label").write_text(text)
    with pytest.raises(VideoError, match=f"absence.label.*{message}"):
        find_sequences(path)


def test_otb_folder_with_two_ground_truths_is_two_sequences(tmp_path):
    path = folder(tmp_path / "walk", "groundtruth_rect.2.txt", "img", lines(TRUTH))
    (path / "groundtruth_rect.1.txt").touch()
    (path / "groundtruth_rect_old.txt").write_text(lines(TRUTH + 1))  # only named like one
    check(path)
    (path / "groundtruth_rect.1.txt").write_text(lines(TRUTH + 1))
    first, second = find_sequences(path)
    assert (first.name, second.name) == ("walk.1", "walk.2")
    np.testing.assert_allclose(first.boxes, TRUTH + 1)


def test_ground_truth_of_otb_david_begins_at_its_300th_image(tmp_path):
    boxes = np.tile(TRUTH[:1], (471, 1))
    (tmp_path / "David").mkdir()
    (tmp_path / "David" / "groundtruth_rect.txt").write_text(lines(boxes))
    assert find_sequences(tmp_path)[0].begin == 299
    check(folder(tmp_path / "mine" / "david", "groundtruth_rect.txt", "img", lines(TRUTH)), "david")


@pytest.mark.parametrize(
    ("name", "line", "box"),
    [
        ("groundtruth_rect.txt", "215.9;61.1;50.2;50.3;", (215.9, 61.1, 50.2, 50.3)),
        ("groundtruth_rect.txt", "10, 20,30 ,40", (10, 20, 30, 40)),
        ("groundtruth_rect.txt", "10,20 30,40", (10, 20, 30, 40)),
        ("groundtruth.txt", "10,5 15,10 10,15", (10, 5, 5, 10)),  # a triangle
        ("groundtruth.txt", "10.0,5 15,10 10,15 5,10", (5, 5, 10, 10)),
    ],
)
def test_numbers_are_separated_by_commas_semicolons_and_blanks(tmp_path, name, line, box):
    path = folder(tmp_path / "walk", name, "img", f"{line}\n{line}\n")
    np.testing.assert_allclose(find_sequences(path)[0].boxes, [box, box])


@pytest.mark.parametrize("row", ["0,0,0,0", "10,10,0,5", "NaN,NaN,NaN,NaN", "10,10,nan,5", "10,10,-3,5"])
def test_box_without_area_is_an_absent_object(tmp_path, row):
    path = folder(tmp_path / "walk", "groundtruth_rect.txt", "img", f"1,2,3,4\n{row}\n1,2,3,4\n")
    assert np.isnan(find_sequences(path)[0].boxes).all(axis=1).tolist() == [False, True, False]


def test_sequences_of_a_folder_have_natural_order(tmp_path):
    for name in ("10_car", "9_dog", "img"):
        folder(tmp_path / name, "groundtruth_rect.txt", "img", lines(TRUTH))
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("not a sequence")
    assert [sequence.name for sequence in find_sequences(tmp_path)] == ["9_dog", "10_car", "img"]


def test_sequence_has_the_name_of_its_link(tmp_path, monkeypatch):
    for link in ("one", "two"):
        path = folder(tmp_path / "data" / link / "walk", "walk.txt", "rgb", lines(TRUTH))
        (tmp_path / link).symlink_to(path)
        check(tmp_path / link, link)
    monkeypatch.chdir(tmp_path / "one" / "rgb")
    check(Path(".."))


def test_sequence_with_several_links_is_read_once(tmp_path):
    path = folder(tmp_path / "walk", "groundtruth_rect.txt", "img", lines(TRUTH))
    folder(tmp_path / ".thumbnails", "groundtruth_rect.txt", "img", lines(TRUTH))
    (tmp_path / "z").symlink_to(path)
    for paths in ([tmp_path], [tmp_path, tmp_path], [path, tmp_path, tmp_path / "z"]):
        assert [sequence.name for sequence in find_sequences(*paths)] == ["walk"]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("groundtruth_rect.txt", "", "is empty"),
        ("groundtruth_rect.txt", "1,2,3\n", "line 1: expected x,y,w,h, with decimal points, got '1,2,3'"),
        ("groundtruth_rect.txt", "1,2,3,4\n1,2,3,4,5\n", "line 2: expected 4 numbers as in line 1"),
        ("groundtruth_rect.txt", "1,,2,3,4\n", "line 1"),
        ("groundtruth_rect.txt", "1,2,3,4\n\n1,2,3,4\n", "line 2 is blank: .* nan,nan,nan,nan"),
        ("groundtruth_rect.txt", "215,90 61,18 50,02 50,03\n", "line 1: expected x,y,w,h, with decimal points"),
        ("groundtruth_rect.txt", "nan,nan,nan,nan\n", "has no box: expected a line with x,y,w,h for each frame"),
        ("groundtruth_rect.txt", "1,2,3,4\n", "has one box: .* the object in at least two"),
        ("gt.txt", "1,2,3,4,5\n", "line 1: expected x1,y1,x2,y2"),
        ("gt.txt", "20,20,30,30\n60,20,30,30\n", r"line 2 has x2 < x1 .* name the file groundtruth_rect\.txt"),
        ("groundtruth.txt", "1,2,3,4,5,6,7\n", "line 1: expected x,y,w,h or .* a polygon"),
        ("walk.txt", "1,0.5,0.5,0.1,0.1,7\n", "line 1: expected x,y,w,h or x,y,w,h,occluded"),
    ],
)
def test_malformed_ground_truth_is_an_error_with_the_line(tmp_path, name, text, message):
    path = folder(tmp_path / "walk", name, "img", text)
    with pytest.raises(VideoError, match=message):
        find_sequences(path)


def test_ground_truth_that_is_no_text_is_an_error(tmp_path):
    file = folder(tmp_path / "walk", "groundtruth_rect.txt", "img", "") / "groundtruth_rect.txt"
    file.write_bytes("1,2,3,4\n".encode("utf-16"))
    with pytest.raises(VideoError, match=r"cannot be read .* expected a text file"):
        find_sequences(tmp_path)


def test_folder_without_sequences_is_an_error_with_layouts(tmp_path):
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(VideoError, match="groundtruth_rect"):
            find_sequences(path)

"""Results files: a row a frame, kept whatever happens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.results import ResultsWriter, read_seconds

BOX = Box(1, 2, 3.5, 4.25)


def track(frame: int, box: Box | None = BOX) -> Track:
    return Track(frame + 1, frame, frame / 25, "present" if box else "absent", box, 0.5 if box else 0.125, frame // 2)


def named(name: str, frame: int) -> Track:
    return replace(track(frame), object=name)


def rows(path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", ndmin=2)


def test_each_frame_has_a_row_and_absence_is_nan(tmp_path):
    with ResultsWriter(tmp_path / "deep" / "out", "walk") as results:
        for frame in range(5):
            results.write([track(frame, None if frame == 3 else Box(frame, 2, 3.5, 4.25))], 0.01)
    out = tmp_path / "deep" / "out"
    boxes = rows(out / "walk.txt")
    assert boxes.shape == (5, 4)
    assert np.isnan(boxes[3]).all()
    np.testing.assert_array_equal(boxes[4], [4, 2, 3.5, 4.25])
    np.testing.assert_array_equal(rows(out / "walk_confidence.value")[:, 0], [0.5, 0.5, 0.5, 0.125, 0.5])
    np.testing.assert_array_equal(rows(out / "walk_time.txt")[:, 0], 5 * [0.01])
    lines = (out / "walk.csv").read_text().splitlines()
    assert lines[0] == "frame,seconds,state,x,y,w,h,score,model_version,object"
    assert lines[3] == "2,0.080000,present,2.0000,2.0000,3.5000,4.2500,0.500000,1,"
    assert lines[4] == "3,0.120000,absent,,,,,0.125000,1,"


def test_frames_without_a_track_get_a_row_of_nan(tmp_path):
    with ResultsWriter(tmp_path, "walk") as results:
        results.write([track(0)], 0.01)
        results.write([track(3)], 0.01)
        results.write([track(3)], 0.01)  # a restarted detector may say it again
        results.write([track(2)], 0.01)
    boxes = rows(tmp_path / "walk.txt")
    assert np.isnan(boxes).all(axis=1).tolist() == [False, True, True, False]
    assert len((tmp_path / "walk.csv").read_text().splitlines()) == 3


def test_each_object_with_a_name_has_its_own_files_with_a_row_for_every_frame(tmp_path):
    with ResultsWriter(tmp_path, "walk") as results:
        results.write([named("anna", 0)], 0.01)
        results.write([named("zoë", 2), named("anna", 2)], 0.01)
        results.write([named("zoë", 3)], 0.01)
    assert not (tmp_path / "walk.txt").exists()
    for name, present in (("anna", [0, 2]), ("zoë", [2, 3])):
        assert np.flatnonzero(~np.isnan(rows(tmp_path / f"walk-{name}.txt")[:, 0])).tolist() == present
        assert len(rows(tmp_path / f"walk-{name}_time.value")) == len(rows(tmp_path / f"walk-{name}.txt")) == 4
    table = [line.split(",")[::9] for line in (tmp_path / "walk.csv").read_text().splitlines()[1:]]
    assert table == [["0", "anna"], ["2", "zoë"], ["2", "anna"], ["3", "zoë"]]


def test_a_file_of_something_else_that_has_the_name_of_an_object_file_is_kept(tmp_path, caplog):
    (tmp_path / "walk-2.txt").write_text("dear to somebody")
    for again in (False, True):
        with ResultsWriter(tmp_path, "walk", again=again) as results:
            for frame in range(1 + again):
                results.write([named("2", frame), named("anna", frame)], 0.01)
            results.publish()
    assert (tmp_path / "walk-2.txt").read_text() == "dear to somebody"
    assert "the boxes of 2 are in walk.csv only" in caplog.text
    assert len(rows(tmp_path / "walk-anna.txt")) == 2
    assert len((tmp_path / "walk.csv").read_text().splitlines()) == 5


def test_an_object_that_begins_under_a_name_too_long_for_a_file_is_in_the_table(tmp_path, caplog):
    source, name = "walk" * 45, "a" * 64
    for again in (False, True):
        with ResultsWriter(tmp_path, source, again=again) as results:
            results.write([named(name, 0)], 0.01)
            results.publish()
    assert f"the boxes of {name} are in {source}.csv only" in caplog.text
    assert [file.name for file in tmp_path.iterdir()] == [f"{source}.csv"]


@pytest.mark.parametrize("file", ["walk.txt", "walk_confidence.value", "walk_time.txt", "walk.csv"])
def test_a_full_disk_is_reported_in_one_line_and_written_rows_are_kept(tmp_path, full, file):
    results = ResultsWriter(tmp_path, "walk")
    results.write([track(0)], 0.01)
    full(tmp_path / file)
    for last in (lambda: results.write([track(1)], 0.01), results.close):  # which tries it once more
        with pytest.raises(VideoError, match=rf"cannot write to .*/{file} any more: No space left on device$"):
            last()
    assert len((tmp_path / file).read_text().splitlines()) == 1 + (file == "walk.csv")


def test_a_path_that_cannot_be_written_is_an_error_at_once(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(VideoError, match=r"cannot write .*: give another place"):
        ResultsWriter(tmp_path / "file" / "out", "walk")
    (tmp_path / "out" / "walk.csv").mkdir(parents=True)
    with pytest.raises(VideoError, match=r"cannot write .*: give another place"):
        ResultsWriter(tmp_path / "out", "walk")


def test_processing_times_are_read_back_except_for_damaged_rows(tmp_path):
    with ResultsWriter(tmp_path, "walk") as results:
        results.write([named("anna", 0)], 0.25)
        results.write([named("anna", 1), named("ben", 1)], 0.5)
        results.write([named("ben", 2)], 0.75)
    assert read_seconds(tmp_path, "walk") == {0: 0.25, 1: 0.5, 2: 0.75}
    file = tmp_path / "walk-ben_time.value"
    file.write_bytes(file.read_bytes().removesuffix(b"00\n"))
    assert read_seconds(tmp_path, "walk") == {0: 0.25, 1: 0.5}
    assert read_seconds(tmp_path / "none", "walk") == {}

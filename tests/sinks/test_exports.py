"""Formats that are made from a log."""

import sqlite3
from contextlib import closing
from math import nan

import numpy as np
import pytest

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.destinations import Origin, TrackedFrame, export, export_of, open_sink

BOX = Box(10.0, 20.0, 30.5, 40.0)


def present(frame, name, box=BOX):
    state = "present" if box else "absent"
    return Track(frame + 1, frame, frame / 25, state, box, 0.75, 4, 17.5 if frame else None, object=name)


LOG = [
    TrackedFrame([present(0, "anna"), present(0, "")], 0.5),
    TrackedFrame([present(2, "", None)], 0.25),
    TrackedFrame([present(3, "ben"), present(3, "")]),
]


def made(path, name=None, log=LOG):
    export(iter(log), path, export_of(path, name), "walk")
    return path


def test_mot_counts_from_one_has_no_line_for_an_absent_object_and_a_name_keeps_its_id(tmp_path):
    box = "11.00,21.00,30.50,40.00,0.7500,-1,-1,-1"
    assert made(tmp_path / "t.txt").read_text().splitlines() == [f"1,1,{box}", f"1,2,{box}", f"4,3,{box}", f"4,2,{box}"]


@pytest.mark.parametrize(
    ("layout", "files"),
    [
        ("otb", ("{}.txt", "{}_confidence.value", "times/{}_time.txt")),
        ("got10k", ("{0}/{0}_001.txt", "{0}/{0}_confidence.value", "{0}/{0}_time.txt")),
        ("vot", ("{0}/{0}_001.txt", "{0}/{0}_001_confidence.value", "{0}/{0}_001_time.value")),
    ],
)
def test_each_object_has_three_files_with_a_row_for_every_frame(tmp_path, layout, files):
    made(tmp_path, layout)
    for name, there in (("walk", [0, 3]), ("walk-anna", [0]), ("walk-ben", [3])):
        boxes, scores, seconds = (np.loadtxt(tmp_path / each.format(name), delimiter=",") for each in files)
        assert np.flatnonzero(~np.isnan(boxes[:, 0])).tolist() == there
        np.testing.assert_array_equal(boxes[there[0]], BOX)
        assert len(scores) == 4
        np.testing.assert_array_equal(seconds, [0.5, nan, 0.25, nan])
    made(tmp_path / "ndjson", layout, [TrackedFrame(frame.tracks) for frame in LOG])
    assert not (tmp_path / "ndjson" / files[2].format("walk")).exists(), "an NDJSON log has no processing times"


def test_a_database_and_a_parquet_file_have_a_row_for_each_track(tmp_path):
    with closing(sqlite3.connect(made(tmp_path / "t.sqlite"))) as database:
        columns = "frame, seq, seconds, state, x, w, score, model_version, pts, object"
        assert database.execute(f"SELECT {columns} FROM tracks").fetchall()[1:3] == [
            (0, 1, 0.0, "present", 10.0, 30.5, 0.75, 4, None, ""),
            (2, 3, 0.08, "absent", None, None, 0.75, 4, 17.5, ""),
        ]
        with pytest.raises(sqlite3.IntegrityError):
            database.execute("INSERT INTO tracks SELECT * FROM tracks")
        everything = database.execute("SELECT * FROM tracks")
        table = pytest.importorskip("pyarrow.parquet").read_table(made(tmp_path / "t.parquet"))
        assert table.column_names == [name for name, *_ in everything.description]
        assert [tuple(row.values()) for row in table.to_pylist()] == everything.fetchall()


@pytest.mark.parametrize("disk", [1 << 16], indirect=True)
@pytest.mark.parametrize("suffix", [".txt", ".sqlite", ".parquet"])
def test_a_file_for_which_the_disk_has_no_room_is_an_error_and_the_one_before_is_kept(disk, suffix):
    (disk / f"t{suffix}").write_text("dear to somebody")
    (disk / "ballast").write_bytes(bytes((1 << 16) - 4096))
    with pytest.raises(VideoError, match="cannot write"):
        made(disk / f"t{suffix}", log=[TrackedFrame([present(frame, "")]) for frame in range(999)])
    assert {file.name for file in disk.iterdir()} == {"ballast", f"t{suffix}"}
    assert (disk / f"t{suffix}").read_text() == "dear to somebody"


@pytest.mark.parametrize("name", ["t.xls", "folder", "t.csv"])
def test_a_name_that_does_not_say_the_format_needs_the_option(tmp_path, name):
    with pytest.raises(VideoError, match="give --format, one of mot, sqlite"):
        export_of(tmp_path / name, None)


def test_a_log_is_continued_by_no_export_and_an_export_is_no_sink(tmp_path):
    with pytest.raises(VideoError, match="use catstream export"):
        open_sink(str(tmp_path / "t.sqlite"), Origin())

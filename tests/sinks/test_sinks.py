"""Sinks: what each kind of file holds, and that it holds it at once."""

from __future__ import annotations

import csv
import json
import sqlite3
from contextlib import ExitStack, closing
from dataclasses import asdict, replace

import pytest

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.formats import NdjsonSink
from catstream.sinks.results import ResultsWriter
from catstream.sinks.sink import SUFFIXES, open_files, reader
from catstream.video.source import open_source

BOX = Box(10.0, 20.0, 30.5, 40.0)

TRACKS = [
    Track(1, 0, 0.0, "bootstrapping", Box(10.0, 20.0, 30.5, 40.0), 1.0, 0),
    Track(2, 1, 0.04, "absent", None, 0.125, 3),
    Track(4, 3, 0.12, "present", Box(-2.0, 21.0, 30.0, 40.0), 0.75, 4, 17.5),
]


@pytest.fixture
def filled(tmp_path):
    """A file that holds the tracks, as it is before it is closed."""
    with ExitStack() as stack:

        def fill(name):
            (sink,) = stack.enter_context(open_files([tmp_path / name]))
            for track in TRACKS:
                sink.write([track])
            return tmp_path / name

        yield fill


def closed(path, tracks=TRACKS):
    """A file of the tracks that was closed."""
    with open_files([path]) as (sink,):
        for track in tracks:
            sink.write([track])
    return path


def test_ndjson_has_every_field_of_a_track(filled):
    objects = [json.loads(line) for line in filled("tracks.ndjson").read_text().splitlines()]
    assert objects == [{**asdict(track), "box": track.box and list(track.box)} for track in TRACKS]


def test_csv_is_that_of_the_results(filled, tmp_path):
    path = filled("tracks.csv")
    with ResultsWriter(tmp_path / "results", "run") as results:
        for track in TRACKS:
            results.write([track], 0.0)
    assert path.read_text() == (tmp_path / "results" / "run.csv").read_text()
    assert [row["state"] for row in csv.DictReader(path.read_text().splitlines())] == [track.state for track in TRACKS]


def test_mot_counts_from_one_and_has_no_line_if_the_object_is_absent(filled):
    assert filled("tracks.txt").read_text() == (
        "1,1,11.00,21.00,30.50,40.00,1.0000,-1,-1,-1\n4,1,-1.00,22.00,30.00,40.00,0.7500,-1,-1,-1\n"
    )


def test_a_name_keeps_its_id_in_mot_text(tmp_path):
    with open_files([tmp_path / "tracks.txt"]) as (sink,):
        for frame, names in enumerate([["anna", "ben"], ["ben"], ["carl", "ben", "anna"]]):
            sink.write([Track(frame + 1, frame, 0.0, "present", BOX, 0.5, 1, object=name) for name in names])
    ids = [line.split(",")[:2] for line in (tmp_path / "tracks.txt").read_text().splitlines()]
    assert ids == [["1", "1"], ["1", "2"], ["2", "2"], ["3", "3"], ["3", "2"], ["3", "1"]]


def test_until_the_end_the_tracks_of_a_format_that_is_made_then_are_in_an_ndjson_file_which_is_kept(tmp_path):
    files = [tmp_path / name for name in ("tracks.sqlite", "tracks.json", "tracks.parquet")]
    with open_files(files) as (sink,):
        for track in TRACKS:
            sink.write([track])
        assert [path.name for path in tmp_path.iterdir()] == ["tracks.ndjson"]
        assert list(NdjsonSink.tracks(tmp_path / "tracks.ndjson")) == TRACKS
    assert {path.name for path in tmp_path.iterdir()} == {"tracks.ndjson", *(path.name for path in files)}
    assert list(NdjsonSink.tracks(tmp_path / "tracks.ndjson")) == TRACKS


def test_an_ndjson_file_from_which_another_is_made_may_be_given_too(tmp_path):
    with open_files([tmp_path / "t.sqlite", tmp_path / "t.ndjson"]) as sinks:
        assert len(sinks) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"t.ndjson", "t.sqlite"}


def test_a_database_has_a_row_for_each_track(tmp_path):
    with closing(sqlite3.connect(closed(tmp_path / "tracks.sqlite"))) as database:
        rows = database.execute("SELECT frame, seq, seconds, state, x, w, score, model_version, pts FROM tracks")
        assert rows.fetchall() == [
            (0, 1, 0.0, "bootstrapping", 10.0, 30.5, 1.0, 0, None),
            (1, 2, 0.04, "absent", None, None, 0.125, 3, None),
            (3, 4, 0.12, "present", -2.0, 30.0, 0.75, 4, 17.5),
        ]
        with pytest.raises(sqlite3.IntegrityError):
            database.execute("INSERT INTO tracks SELECT * FROM tracks")


def test_json_is_one_array(tmp_path):
    objects = json.loads(closed(tmp_path / "tracks.json").read_text())
    assert objects == [{**asdict(track), "box": track.box and list(track.box)} for track in TRACKS]


def test_parquet_has_the_columns_of_the_database(tmp_path):
    arrow = pytest.importorskip("pyarrow.parquet")
    table = arrow.read_table(closed(tmp_path / "tracks.parquet"))
    with closing(sqlite3.connect(closed(tmp_path / "other.sqlite"))) as database:
        cursor = database.execute("SELECT * FROM tracks")
        assert table.column_names == [name for name, *_ in cursor.description]
        assert [tuple(row.values()) for row in table.to_pylist()] == cursor.fetchall()


def test_a_run_without_tracks_gives_files_without_rows(tmp_path):
    arrow = pytest.importorskip("pyarrow.parquet")
    assert json.loads(closed(tmp_path / "t1.json", []).read_text()) == []
    assert arrow.read_table(closed(tmp_path / "t2.parquet", [])).num_rows == 0
    with closing(sqlite3.connect(closed(tmp_path / "t3.sqlite", []))) as database:
        assert database.execute("SELECT count(*) FROM tracks").fetchone() == (0,)


@pytest.mark.parametrize("disk", [1 << 16], indirect=True)
@pytest.mark.parametrize("suffix", [".json", ".sqlite", ".parquet"])
def test_a_format_for_which_the_disk_has_no_room_at_the_end_is_an_error_and_the_tracks_are_kept(disk, suffix):
    path, stack = disk / f"t{suffix}", ExitStack()
    (sink,) = stack.enter_context(open_files([path]))
    for track in TRACKS:
        sink.write([track])
    (disk / "ballast").write_bytes(bytes((1 << 16) - 4096))
    with pytest.raises(VideoError, match=r"cannot write .*/t\.\w+ \(.*\): its tracks are in .*/t.ndjson"):
        stack.close()
    assert list(NdjsonSink.tracks(disk / "t.ndjson")) == TRACKS
    assert {file.name for file in disk.iterdir()} == {"ballast", "t.ndjson"}


@pytest.mark.parametrize("suffix", [".ndjson", ".jsonl", ".csv"])
def test_an_open_file_is_read_back_up_to_a_line_that_a_power_cut_tore(filled, suffix):
    path = filled(f"tracks{suffix}")
    kept = [replace(track, seq=track.frame + 1, pts=None) for track in TRACKS] if suffix == ".csv" else TRACKS
    assert list(reader(path)(path)) == kept
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines()[-1][:9] + bytes(7))
    assert list(reader(path)(path)) == kept
    path.write_bytes(whole + whole.splitlines()[-1])
    assert list(reader(path)(path)) == kept, "without its line end, a row may be incomplete"


@pytest.mark.parametrize("suffix", [".ndjson", ".csv", ".txt"])
def test_a_file_that_is_written_again_stays_as_it_was_until_it_is_published(tmp_path, suffix):
    path = closed(tmp_path / f"tracks{suffix}")
    before = path.read_text()
    with open_files([path], again=True) as (sink,):
        sink.write(TRACKS[:1])
        assert path.read_text() == before
    assert path.read_text() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    with open_files([path], again=True) as (sink,):
        sink.write(TRACKS[:2])
        sink.publish()
        sink.write(TRACKS[2:])
        assert path.read_text() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_video_has_the_frames_of_its_tracks(demo_video, tmp_path):
    source, _ = demo_video(8)
    frames = slice(1, 8, 2)  # frames 1, 3, 5, 7, counted 0 to 3
    with open_files([tmp_path / "walk.mp4"], str(source), frames) as (sink,):
        for track in TRACKS:
            sink.write([track])
        with pytest.raises(VideoError, match="has no frame 4"):
            sink.write([Track(5, 4, 0.2, "absent", None, 0.0, 4)])
    with open_source(str(tmp_path / "walk.mp4")) as frames:
        assert sum(1 for _ in frames) == len(TRACKS)


@pytest.mark.parametrize("disk", [4096], indirect=True)
def test_a_new_file_whose_first_line_the_disk_does_not_take_is_not_left(disk):
    (disk / "ballast").write_bytes(bytes(4096))
    with pytest.raises(VideoError, match="No space left on device"), open_files([disk / "t.csv"]):
        pass
    assert [file.name for file in disk.iterdir()] == ["ballast"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_existing_file_is_not_overwritten(tmp_path, suffix):
    path = tmp_path / f"tracks{suffix}"
    path.write_text("dear to somebody")
    with pytest.raises(VideoError, match="exists already"), open_files([path], "0"):
        pass
    assert path.read_text() == "dear to somebody"


@pytest.mark.parametrize(
    ("name", "source", "words"),
    [
        ("tracks.xls", None, "ends with .ndjson, .jsonl, .csv, .txt, .mp4, .json, .sqlite, .parquet"),
        ("none/tracks.csv", None, "a folder that exists and that you may write to"),
        ("none/tracks.sqlite", None, "a folder that exists and that you may write to"),
        ("walk.mp4", None, "give their source"),
        ("walk.mp4", "rtsp://me:secret@127.0.0.1/cam", r"again, but rtsp://127.0.0.1/cam is live"),
    ],
)
def test_an_output_that_cannot_be_written_is_rejected_before_any_work(tmp_path, name, source, words):
    with pytest.raises(VideoError, match=words), open_files([tmp_path / name], source):
        pass
    assert not list(tmp_path.iterdir())

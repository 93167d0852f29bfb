"""Sinks: what each kind of file holds, and that it holds it at once."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
from contextlib import closing
from dataclasses import asdict, replace

import pytest

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.sink import SUFFIXES, open_sink, reader
from catstream.sinks.sqlite import SqliteSink
from catstream.video.results import ResultsWriter
from catstream.video.source import open_source

BOX = Box(10.0, 20.0, 30.5, 40.0)

TRACKS = [
    Track(1, 0, 0.0, "bootstrapping", Box(10.0, 20.0, 30.5, 40.0), 1.0, 0),
    Track(2, 1, 0.04, "absent", None, 0.125, 3),
    Track(4, 3, 0.12, "present", Box(-2.0, 21.0, 30.0, 40.0), 0.75, 4, 17.5),
]

#: Formats that hold all that was written.
COMPLETE = [".ndjson", ".jsonl", ".json", ".csv", ".sqlite", ".parquet"]


@pytest.fixture
def filled(tmp_path):
    """An open sink that holds the tracks: what was written is there before it is closed."""
    opened = []

    def fill(name):
        opened.append(open_sink(tmp_path / name))
        for track in TRACKS:
            opened[-1].write([track])
        return tmp_path / name

    yield fill
    for sink in opened:
        sink.close()


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
    with closing(open_sink(tmp_path / "tracks.txt")) as sink:
        for frame, names in enumerate([["anna", "ben"], ["ben"], ["carl", "ben", "anna"]]):
            sink.write([Track(frame + 1, frame, 0.0, "present", BOX, 0.5, 1, object=name) for name in names])
    ids = [line.split(",")[:2] for line in (tmp_path / "tracks.txt").read_text().splitlines()]
    assert ids == [["1", "1"], ["1", "2"], ["2", "2"], ["3", "3"], ["3", "2"], ["3", "1"]]


def test_a_database_can_be_read_while_it_is_written(filled):
    path = filled("tracks.sqlite")
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
        rows = database.execute("SELECT frame, seq, state, x, w, score, model_version, pts FROM tracks").fetchall()
        assert database.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    assert rows == [
        (0, 1, "bootstrapping", 10.0, 30.5, 1.0, 0, None),
        (1, 2, "absent", None, None, 0.125, 3, None),
        (3, 4, "present", -2.0, 30.0, 0.75, 4, 17.5),
    ]


def test_json_is_one_array_once_it_is_closed(tmp_path):
    sink = open_sink(tmp_path / "tracks.json")
    for track in TRACKS:
        sink.write([track])
    sink.close()
    objects = json.loads((tmp_path / "tracks.json").read_text())
    assert objects == [{**asdict(track), "box": track.box and list(track.box)} for track in TRACKS]
    open_sink(tmp_path / "empty.json").close()
    assert json.loads((tmp_path / "empty.json").read_text()) == []


def test_a_parquet_file_is_written_at_close_from_buffered_rows(tmp_path):
    arrow = pytest.importorskip("pyarrow.parquet")
    sink = open_sink(tmp_path / "tracks.parquet")
    for track in TRACKS:
        sink.write([track])
    assert list(SqliteSink.tracks(tmp_path / "tracks.parquet.sqlite")) == TRACKS
    sink.close()
    assert [path.name for path in tmp_path.iterdir()] == ["tracks.parquet"]
    table = arrow.read_table(tmp_path / "tracks.parquet").to_pydict()
    assert table["frame"] == [0, 1, 3]
    assert table["state"] == [track.state for track in TRACKS]
    assert table["h"] == [40.0, None, 40.0]


@pytest.fixture
def left(tmp_path):
    """A file of the tracks as it is when it is closed, or as a process that is killed leaves it."""

    def leave(name, closed):
        (tmp_path / "open").mkdir()
        with closing(open_sink(tmp_path / "open" / name)) as sink:
            for track in TRACKS:
                sink.write([track])
            if not closed:
                shutil.copytree(tmp_path / "open", tmp_path / "left")
        return tmp_path / ("open" if closed else "left") / name

    return leave


@pytest.mark.parametrize("suffix", COMPLETE)
@pytest.mark.parametrize("closed", [True, False], ids=["closed", "killed"])
def test_a_file_continues_after_the_requested_frame(left, suffix, closed):
    path = left(f"tracks{suffix}", closed)
    read, before = reader(path), path.read_bytes() if path.exists() else b""
    kept = [replace(track, seq=track.frame + 1, pts=None) for track in TRACKS] if suffix == ".csv" else TRACKS
    assert list(read(path)) == kept
    with closing(open_sink(path, keep=2)) as again:
        again.write([TRACKS[2]])
    assert list(read(path)) == kept
    if suffix not in (".sqlite", ".parquet"):
        assert path.read_bytes().removesuffix(b"]\n") == before.removesuffix(b"]\n")


@pytest.mark.parametrize("suffix", [".ndjson", ".json", ".csv"])
def test_a_line_that_a_power_cut_tore_is_not_read_and_is_cut_off(left, suffix):
    path = left(f"tracks{suffix}", closed=False)
    whole = path.read_bytes()
    path.write_bytes(whole + whole.splitlines()[-1][:9] + bytes(7))
    assert len(list(reader(path)(path))) == len(TRACKS)
    open_sink(path, keep=9).close()
    assert path.read_bytes().removesuffix(b"]\n") == whole


def test_a_video_has_the_frames_of_its_tracks(demo_video, tmp_path):
    source, _ = demo_video(8)
    sink = open_sink(tmp_path / "walk.mp4", str(source), slice(1, 8, 2))  # frames 1, 3, 5, 7, counted 0 to 3
    for track in TRACKS:
        sink.write([track])
    with pytest.raises(VideoError, match="has no frame 4"):
        sink.write([Track(5, 4, 0.2, "absent", None, 0.0, 4)])
    sink.close()
    with open_source(str(tmp_path / "walk.mp4")) as frames:
        assert sum(1 for _ in frames) == len(TRACKS)


@pytest.mark.parametrize("suffix", [".ndjson", ".json", ".csv", ".txt"])
def test_a_full_disk_is_reported_in_one_line_and_written_rows_are_kept(tmp_path, full, suffix):
    path = tmp_path / f"tracks{suffix}"
    sink = open_sink(path)
    sink.write([TRACKS[0]])
    before = path.read_text()
    full(path)
    for last in (lambda: sink.write([TRACKS[2]]), sink.close):  # which tries it once more
        with pytest.raises(VideoError, match=r"cannot write to .* any more: No space left on device$"):
            last()
    assert path.read_text() == before


@pytest.mark.parametrize("disk", [4096], indirect=True)
def test_a_new_file_whose_first_line_the_disk_does_not_take_is_not_left(disk):
    (disk / "ballast").write_bytes(bytes(4096))
    with pytest.raises(VideoError, match="No space left on device"):
        open_sink(disk / "t.csv")
    assert [file.name for file in disk.iterdir()] == ["ballast"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_existing_file_is_not_overwritten(tmp_path, suffix):
    path = tmp_path / f"tracks{suffix}"
    path.write_text("dear to somebody")
    with pytest.raises(VideoError, match="exists already"):
        open_sink(path, "0")
    assert path.read_text() == "dear to somebody"


@pytest.mark.parametrize(
    ("name", "source", "words"),
    [
        ("tracks.xls", None, "ends with .ndjson, .jsonl, .json, .csv, .txt, .sqlite, .parquet, .mp4"),
        ("none/tracks.csv", None, "a folder that exists and that you may write to"),
        ("none/tracks.sqlite", None, "a folder that exists and that you may write to"),
        ("walk.mp4", None, "give their source"),
        ("walk.mp4", "rtsp://127.0.0.1/cam", "is live"),
    ],
)
def test_an_output_that_cannot_be_written_is_rejected_before_any_work(tmp_path, name, source, words):
    with pytest.raises(VideoError, match=words):
        open_sink(tmp_path / name, source)

"""The database of a run: each frame is in it at once, others read it meanwhile, and a resumed run continues it."""

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace

import pytest

from catstream.base.box import Box
from catstream.errors import VideoError
from catstream.output import remote
from catstream.output.destinations import Header, Origin, TrackedFrame, open_sink
from catstream.output.track_log import Log, RunFiles
from catstream.wire.messages import Track

TRACKS = [
    Track(0, 0.0, "bootstrapping", Box(1 / 3, 20.0, 30.5, 40.0), 1.0, 0, checked="keyframe", probability=1.0),
    Track(1, 0.04, "absent", None, 0.125, 3, 17.5, "anna", 1),
    Track(3, 0.12, "present", Box(-2.0, 21.0, 30.0, 40.0), 0.43, 4, 18.5, "anna", 1, doubtful=True),
]


def read(path):
    return [frame.tracks for frame in Log(path)]


def test_readers_see_each_frame_at_once_and_block_nothing(tmp_path):
    path = tmp_path / "t.sqlite"
    with closing(open_sink(str(path), Origin())) as sink, closing(sqlite3.connect(path)) as other:
        sink.write(TrackedFrame(TRACKS[:1]))
        other.execute("BEGIN")
        assert other.execute("SELECT frame, x, object FROM tracks").fetchall() == [(0, 1 / 3, "")]
        sink.write(TrackedFrame(TRACKS[1:2]))  # while that transaction goes on
        assert other.execute("SELECT count(*) FROM tracks").fetchone() == (1,)
        other.execute("END")
        assert read(path) == [[each] for each in TRACKS[:2]]
    assert read(path) == [[each] for each in TRACKS[:2]]
    assert [file.name for file in tmp_path.iterdir()] == ["t.sqlite"]


def test_database_of_a_killed_run_is_continued_after_its_last_frame(tmp_path):
    with closing(open_sink(str(tmp_path / "t.sqlite"), Origin())) as sink:
        for each in TRACKS[:2]:
            sink.write(TrackedFrame([each]))
        killed = shutil.copytree(tmp_path, tmp_path / "killed")  # the files as they are before the end
    path, log = killed / "t.sqlite", killed / "t.ndjson"
    run = RunFiles(Origin(), None, [str(path)])
    run.check(overwrite=False, earlier=run.destinations)
    assert run.position()[0] == 2
    with replace(run, destinations=[str(path), str(log)]).opened("", resume=True) as files:
        assert read(path) == read(log) == [[each] for each in TRACKS[:2]]
        files.write(TrackedFrame(TRACKS[2:]))
    assert read(path) == read(log) == [[each] for each in TRACKS]


@pytest.mark.parametrize("begun", ["", "PRAGMA journal_mode = WAL"])
def test_database_without_a_table_is_continued(tmp_path, begun):
    path = tmp_path / "t.sqlite"
    path.touch()
    with closing(sqlite3.connect(path)) as database:
        database.execute(begun)
    run = RunFiles(Origin(), None, [str(path)])
    run.check(overwrite=False, earlier=run.destinations)
    assert run.position()[0] == 0
    with run.opened("", resume=True) as files:
        files.write(TrackedFrame(TRACKS[:1]))
    assert read(path) == [TRACKS[:1]]


def test_frames_wait_in_memory_while_the_database_is_locked(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(remote, "_STABLE_SECONDS", 0.0)
    path = tmp_path / "t.sqlite"
    with closing(open_sink(str(path), Origin())) as sink:
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            for track in TRACKS:
                sink.write(TrackedFrame([track]))
            assert read(path) == []
        sink.write(TrackedFrame([replace(TRACKS[0], frame=9)]))
        assert [frame.number for frame in Log(path)] == [0, 1, 3, 9]
    assert [message.rpartition("; ")[2].rpartition(": ")[2] for message in caplog.messages] == [
        "frames wait in memory",
        "recovered",
    ]


def test_frames_dropped_from_a_full_queue_are_reported_at_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr("catstream.output.database._MOST_WAITING", 2)
    monkeypatch.setattr("catstream.output.database.CLOSE_SECONDS", 0.0)
    path = tmp_path / "t.sqlite"
    sink = open_sink(str(path), Origin())
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        for track in TRACKS:
            sink.write(TrackedFrame([track]))
    sink.write(TrackedFrame([replace(TRACKS[0], frame=9)]))
    with pytest.raises(VideoError, match="lacks 2 frames, because another program locked it"):
        sink.close()
    assert [frame.number for frame in Log(path)] == [3, 9]


def test_database_has_the_header_of_the_run(tmp_path):
    header = Header(source="walk.mp4", size=(320, 240), start=100, stride=2)
    with closing(open_sink(str(tmp_path / "t.sqlite"), Origin(header=header))) as sink:
        sink.write(TrackedFrame(TRACKS[:1]))
    assert Log(tmp_path / "t.sqlite").header() == header

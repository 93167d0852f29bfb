"""`catstream sink`, beside a pipeline that runs."""

from __future__ import annotations

import json
import select
import signal
import sqlite3
import time
from contextlib import closing

from catstream.messages.kinds import Health, Run, Track
from catstream.messages.names import counted
from catstream.pipeline import Pipeline
from catstream.settings import Settings
from catstream.video.source import open_source
from catstream.wire.channels import HEALTH, TRACKS, TRAINING
from catstream.wire.newest import Publisher

FILES = ["tracks.ndjson", "tracks.sqlite", "walk.mp4", "t.parquet"]


def test_tracks_are_written_to_files_and_stay_there(long_video, catstream, tmp_path):
    source, box = long_video
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    with Pipeline(source, [float(side) for side in box.split(",")], Settings(run={"unstored_frames": 1})) as pipeline:
        sinks = {}
        for folder in (whole, stopped):
            folder.mkdir()
            files = [folder / name for name in FILES]
            sinks[folder] = catstream("sink", *files, "--source", source, "--endpoint", pipeline.endpoint)
        waiting = set(sinks)
        for track in pipeline:
            if waiting := {folder for folder in waiting if not holds(folder) and sinks[folder].poll() is None}:
                select.select([sinks[folder].stderr for folder in waiting], [], [], 0.3)  # while they start, few pass
            if track.frame > 30 and stopped not in waiting and sinks[stopped].poll() is None:
                sinks[stopped].send_signal(signal.SIGINT)
                sinks[stopped].wait(60)
        told = {folder: sink.communicate(timeout=60)[1] for folder, sink in sinks.items()}
    for folder, sink in sinks.items():
        assert sink.returncode == 0, told[folder]
    assert written(whole, told[whole])[-1] == 59
    assert written(stopped, told[stopped])[-1] < 59


def holds(folder):
    """Whether tracks have come there."""
    file = folder / FILES[0]
    return file.exists() and file.stat().st_size > 0


def written(folder, errors):
    """The frames whose tracks are there, in each of the files."""
    frames = [json.loads(line)["frame"] for line in (folder / "tracks.ndjson").read_text().splitlines()]
    assert frames == list(range(frames[0], frames[0] + len(frames)))
    assert f"{counted(len(frames), 'track')}, {frames[0]} missed" in errors, "those before it came"
    with closing(sqlite3.connect(folder / "tracks.sqlite")) as database:
        assert [frame for (frame,) in database.execute("SELECT frame FROM tracks")] == frames
    with open_source(str(folder / "walk.mp4")) as shown:
        assert sum(1 for _ in shown) == len(frames)
    assert (folder / "t.parquet").stat().st_size > 0
    return frames


def test_repeated_frames_of_a_restarted_detector_are_skipped_and_another_run_ends_the_sink(
    catstream, endpoint, tmp_path, until
):
    file = tmp_path / "tracks.ndjson"
    with (
        Publisher(HEALTH, endpoint, "detector") as health,
        Publisher(TRACKS, endpoint) as tracks,
        Publisher(
            TRAINING, endpoint, first_message=Run.from_settings(Settings(run={"unstored_frames": 100}).portable())
        ) as training,
    ):
        sink = catstream("sink", file, "--endpoint", endpoint)
        until(file.exists, lambda: health.send(Health("detector", time.time())))

        def follow(first, last, written):
            for frame in range(first, last):
                tracks.send(Track(frame + 1, frame, frame / 30, "absent", None, 0.0, 0))
            until(lambda: len(file.read_text().splitlines()) == written, training.serve_late_joiners)

        until(lambda: tracks.has_subscribers, tracks.serve_late_joiners)
        follow(0, 300, written=300)
        follow(205, 310, written=310)
        follow(0, 200, written=310)
        errors = sink.communicate(timeout=60)[1]
    assert sink.returncode == 0, errors
    frames = [json.loads(line)["frame"] for line in file.read_text().splitlines()]
    assert frames == list(range(310))
    assert "310 tracks, 0 missed: the run had no end, and another one started" in errors


def test_without_a_pipeline_no_file_is_left(fail, tmp_path):
    error = fail("sink", tmp_path / "tracks.csv", "--endpoint", tmp_path, "--wait", 1)
    assert "is a pipeline running there?" in error
    assert not (tmp_path / "tracks.csv").exists()

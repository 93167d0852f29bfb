"""`catstream sink`, beside a pipeline that runs."""

from __future__ import annotations

import json
import select
import signal
import sqlite3
import time
from contextlib import closing

import pytest

from catstream.messages import Health, Track
from catstream.pipeline import Pipeline
from catstream.recording.file import run_of
from catstream.settings import Settings
from catstream.video.source import open_source
from catstream.wire.endpoint import Endpoint
from catstream.wire.sockets import Publisher


@pytest.mark.parametrize("stopped", [False, True], ids=["to the end", "stopped"])
def test_tracks_go_to_files_and_stay_there(video, catstream, tmp_path, stopped):
    source, box = video
    files = [tmp_path / name for name in ("tracks.ndjson", "tracks.sqlite", "walk.mp4", "t.parquet")]
    with Pipeline(source, [float(side) for side in box.split(",")], Settings(window=1)) as pipeline:
        sink = catstream("sink", *files, "--source", source, "--endpoint", pipeline.endpoint)
        for track in pipeline:
            if sink.poll() is None:
                select.select([sink.stderr], [], [], 0.3)  # while it starts, few pass
            if stopped and files[0].exists() and files[0].stat().st_size and track.frame > 30:
                sink.send_signal(signal.SIGINT)
                sink.wait(60)
        errors = sink.communicate(timeout=60)[1]
    assert sink.returncode == 0, errors
    frames = [json.loads(line)["frame"] for line in files[0].read_text().splitlines()]
    assert frames == list(range(frames[0], frames[0] + len(frames)))
    assert (frames[-1] == 59) != stopped
    assert f"{len(frames)} tracks, {frames[0]} missed" in errors, "those before it came"
    with closing(sqlite3.connect(files[1])) as database:
        assert [frame for (frame,) in database.execute("SELECT frame FROM tracks")] == frames
    with open_source(str(files[2])) as shown:
        assert sum(1 for _ in shown) == len(frames)
    assert (tmp_path / "t.parquet").stat().st_size > 0
    assert not files[1].with_name("tracks.sqlite-wal").exists()


def test_what_a_restarted_detector_repeats_is_passed_over_and_another_run_is_the_end(
    catstream, folder, tmp_path, until
):
    endpoint, file = Endpoint.parse(str(folder)), tmp_path / "tracks.ndjson"
    with (
        Publisher("health", endpoint, "detector") as health,
        Publisher("tracks", endpoint) as tracks,
        Publisher("lessons", endpoint, greeting=run_of(Settings(window=100))) as lessons,
    ):
        sink = catstream("sink", file, "--endpoint", folder)
        until(file.exists, lambda: health.send(Health("detector", time.time())))

        def follow(first, last, written):
            for frame in range(first, last):
                tracks.send(Track(frame + 1, frame, frame / 30, "absent", None, 0.0, 0))
            until(lambda: len(file.read_text().splitlines()) == written, lessons.welcome)

        until(lambda: tracks.heard, tracks.welcome)
        follow(0, 300, written=300)
        follow(205, 310, written=310)
        follow(0, 200, written=310)
        errors = sink.communicate(timeout=60)[1]
    assert sink.returncode == 0, errors
    frames = [json.loads(line)["frame"] for line in file.read_text().splitlines()]
    assert frames == list(range(310))
    assert "310 tracks, 0 missed: it had no end, and another run began" in errors


def test_where_no_pipeline_is_heard_no_file_is_left(said, tmp_path):
    code, _, errors = said("sink", tmp_path / "tracks.csv", "--endpoint", tmp_path, "--wait", 1)
    assert code == 1
    assert "is a pipeline running there?" in errors
    assert not (tmp_path / "tracks.csv").exists()

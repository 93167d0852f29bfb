"""`catstream sink`: the files that it writes of a running pipeline."""

import json
import select
import signal
import time
from dataclasses import replace
from pathlib import Path

from catstream.base.text import counted
from catstream.pipeline import Pipeline
from catstream.video.source import open_source
from catstream.wire.channels import HEALTH, TRACKS
from catstream.wire.messages import Health, Track
from catstream.wire.newest import Publisher

FILES = ["tracks.ndjson", "t.csv", "walk.mp4"]


def test_sink_writes_files_until_the_end_or_ctrl_c(long_video, catstream, tmp_path):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    with Pipeline(*long_video, {"run.unstored_frames": 1}) as pipeline:
        sinks = {}
        for folder in (whole, stopped):
            folder.mkdir()
            sinks[folder] = catstream("sink", *(folder / name for name in FILES), "--endpoint", pipeline.endpoint)
        waiting = set(sinks)
        for track in pipeline:
            if waiting := {folder for folder in waiting if not holds(folder) and sinks[folder].poll() is None}:
                select.select([sinks[folder].stderr for folder in waiting], [], [], 1)  # while they start, few pass
            if track.frame > 30 and stopped not in waiting and sinks[stopped].poll() is None:
                sinks[stopped].send_signal(signal.SIGINT)
                sinks[stopped].wait(500)
        told = {folder: sink.communicate(timeout=500)[1] for folder, sink in sinks.items()}
    for folder, sink in sinks.items():
        assert sink.returncode == 0, told[folder]
    assert written(whole, told[whole])[-1] == 59
    assert written(stopped, told[stopped])[-1] < 59


def holds(folder):
    """Return True once the folder has tracks and a picture."""
    file = folder / FILES[0]
    return file.exists() and file.read_bytes().count(b"\n") > 1 and (folder / "walk.mp4").exists()  # below the header


def written(folder, errors):
    """The frames whose tracks are there, in each of the files."""
    header, *tracks = map(json.loads, (folder / "tracks.ndjson").read_text().splitlines())
    assert (Path(header["source"]).name, header["size"], header["rate"]) == ("demo.mp4", [320, 240], 30)
    frames = [track["frame"] for track in tracks]
    assert frames == list(range(frames[0], frames[0] + len(frames)))
    assert f"{counted(len(frames), 'track')}, {frames[0]} missed" in errors, "those before it came"
    assert len((folder / "t.csv").read_text().splitlines()) == len(frames) + 1
    with open_source(str(folder / "walk.mp4")) as shown:
        assert next(shown).image.shape[1] == 320
    return frames


def test_sink_skips_repeated_frames_and_ends_at_another_run(catstream, endpoint, tmp_path, until):
    file = tmp_path / "tracks.ndjson"
    with Publisher(HEALTH, endpoint, "detector") as health:
        sink = catstream("sink", file, "--endpoint", endpoint)
        until(file.exists, lambda: health.send(Health("detector", time.time())))

        def follow(run, *parts, written):
            with Publisher(TRACKS, replace(endpoint, run=run)) as tracks:
                until(lambda: tracks.has_subscribers, tracks.serve_late_joiners)
                for frame in (frame for part in parts for frame in range(*part)):
                    tracks.send(Track(frame, frame / 30, "absent", None, 0.0, 0))
                until(lambda: len(file.read_text().splitlines()) == 1 + written, tracks.serve_late_joiners)

        follow("first", (0, 300), (205, 310), written=310)
        follow("second", (0, 200), written=310)
        errors = sink.communicate(timeout=500)[1]
    assert sink.returncode == 0, errors
    frames = [json.loads(line)["frame"] for line in file.read_text().splitlines()[1:]]
    assert frames == list(range(310))
    assert "310 tracks, 0 missed: the run had no end, and another one started" in errors


def test_restarted_sink_renames_its_earlier_file(catstream, endpoint, tmp_path, until):
    file = tmp_path / "tracks.ndjson"
    file.write_text("of the last start\n")
    with Publisher(HEALTH, endpoint, "detector") as health:
        sink = catstream("sink", file, "--endpoint", endpoint)
        until(
            lambda: len([*tmp_path.glob("*.ndjson")]) == 2 and file.stat().st_size > 0,
            lambda: health.send(Health("detector", time.time())),
        )
        sink.terminate()
        sink.communicate(timeout=500)
    old, new = sorted(tmp_path.glob("*.ndjson"))
    assert (old.read_text(), new, new.read_text().count("\n")) == ("of the last start\n", file, 1)

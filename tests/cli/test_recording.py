"""`catstream track --record`, `record` and `replay`."""

from __future__ import annotations

import json
import signal
import time
from dataclasses import replace

import pytest

from catstream.cli import replay
from catstream.messages.kinds import Features, Model, Track
from catstream.pipeline import Pipeline
from catstream.settings import Settings
from catstream.sinks.recording.file import Recording, RecordingWriter


@pytest.fixture
def recorded(whole_run):
    """A recorded run."""
    return whole_run / "rec"


def test_the_content_of_a_recording_is_reported(whole_run):
    errors = (whole_run / "stderr").read_text()
    assert "recording: rec, 32 features, " in errors
    assert "none missing" in errors


def test_the_learning_is_replayed_and_compared_with_other_settings(recorded, succeed, tmp_path):
    output, _ = succeed("replay", recorded, "--learn", "--set", "coreset.size=32", "--output", tmp_path / "smaller.rec")
    models = Recording(recorded).counts[Model]
    rows = {line.split("  ")[0]: line.split() for line in output.splitlines()}
    assert rows["the same"][3:6] == [str(models), "of", str(models)]
    assert rows["coreset.size=32"][2:5] == ["0", "of", str(models)]
    smaller = Recording(tmp_path / "smaller.rec")
    assert smaller.settings.coreset.size == 32
    assert str(smaller.counts[Model]) == rows["coreset.size=32"][1]


def test_a_model_that_is_not_reproduced_is_an_error(recorded, said, tmp_path):
    recording = Recording(recorded)
    with RecordingWriter(tmp_path / "other.rec", recording.run) as writer:
        for _, message in list(recording.messages())[1:]:
            changed = replace(message, bias=0.0) if isinstance(message, Model) else message
            writer.write(changed)
    code, output, errors = said("replay", tmp_path / "other.rec", "--learn")
    assert code == 1
    assert f"0 of {recording.counts[Model]}" in output
    assert "recorded models were not reproduced" in errors


def test_rejected_training_leaves_no_file_and_may_be_requested_again(recorded, fail, succeed, tmp_path):
    recording, output = Recording(recorded), tmp_path / "models.rec"
    with RecordingWriter(tmp_path / "gap.rec", recording.run) as writer:
        for _, message in list(recording.messages())[1:]:
            if not (isinstance(message, Features) and message.seq == 30):
                writer.write(message)
    learn = ["replay", tmp_path / "gap.rec", "--learn", "--output", output]
    assert "train from the features that it has (--incomplete)" in fail(*learn)
    assert not output.exists()
    succeed(*learn, "--incomplete")
    assert Recording(output).counts[Model]


def test_an_interrupt_leaves_no_part_of_the_models(recorded, said, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(replay, "learn", interrupted)
    code, _, _ = said("replay", recorded, "--learn", "--output", tmp_path / "again.rec")
    assert (code, [*tmp_path.iterdir()]) == (130, [])


def test_a_recording_is_watched_like_a_pipeline(recorded, catstream, tmp_path):
    player = catstream("replay", recorded, "--endpoint", tmp_path, "--fast", "--wait")
    watcher = catstream("watch", "tracks", "--json", "--endpoint", tmp_path)
    output, errors = watcher.communicate(timeout=60)
    assert player.wait(60) == 0
    tracks = [json.loads(line)["frame"] for line in output.splitlines()]
    assert tracks == list(range(32 - len(tracks), 32))
    assert f"{32 - len(tracks)} missed" in errors
    assert ": the source has ended" in errors


def holds_tracks(path):
    """Whether tracks were recorded so far."""
    return path.exists() and path.stat().st_size > 0 and Recording(path).counts[Track] > 0


def test_the_messages_of_a_pipeline_are_recorded_by_another_process(long_video, catstream, tmp_path):
    source, box = long_video
    settings, paths = (
        Settings(run={"unstored_frames": 1, "endpoint": str(tmp_path)}),
        [tmp_path / "whole.rec", tmp_path / "stopped.rec"],
    )
    with Pipeline(source, [float(side) for side in box.split(",")], settings) as pipeline:
        tracks = iter(pipeline)
        next(tracks)
        recorders = [catstream("record", "--output", path, "--endpoint", tmp_path) for path in paths]
        while not all(path.exists() for path in paths):  # they have found the pipeline, which waits for its tracks
            time.sleep(0.01)
        for track in tracks:
            if recorders[1].poll() is None and track.frame > 40 and all(map(holds_tracks, paths)):
                recorders[1].send_signal(signal.SIGINT)
                recorders[1].wait(60)
        told = [recorder.communicate(timeout=60)[1] for recorder in recorders]
    for path, recorder, errors, stopped in zip(paths, recorders, told, (False, True), strict=True):
        assert recorder.returncode == 0, errors
        recording = Recording(path)
        assert recording.settings.run.unstored_frames == 1
        assert recording.counts[Features]
        assert recording.counts[Track]
        assert (recording.end is None) == stopped
        assert f"{recording.missing[Features]} features" in errors

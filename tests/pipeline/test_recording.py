"""A run that records itself: no features are missing, whatever dies, and the learning can be replayed."""

from __future__ import annotations

import os
import signal

import pytest

from catstream.errors import RecordingError
from catstream.messages.kinds import Features, Model
from catstream.pipeline import Pipeline
from catstream.settings import Settings
from catstream.sinks.recording.file import Recording
from catstream.sinks.recording.learning import learn


def test_no_features_are_missing_and_every_model_is_reproduced_whichever_process_dies(video, tmp_path):
    path, boxes = video
    with Pipeline(path, boxes[0], Settings(run={"unstored_frames": 16}), record=tmp_path / "run.rec") as pipeline:
        for track in pipeline:
            if track.frame == 10:
                for victim in ("compressor", "detector"):
                    os.kill(pipeline.pids[victim], signal.SIGKILL)
    recording = Recording(tmp_path / "run.rec")
    assert [features.seq for features in recording.features()] == list(range(1, pipeline.frames + 1))
    assert recording.end.totals == {"sent": pipeline.frames, "stored": pipeline.frames}
    lesson = learn(recording, recording.settings)
    assert lesson.identical == recording.counts[Model] > 5
    assert recording.missing[Features] == 0


def test_a_recording_that_is_there_is_not_written_over(video, tmp_path):
    path, boxes = video
    (tmp_path / "run.rec").write_text("dear to somebody")
    with pytest.raises(RecordingError, match="exists already"):
        Pipeline(path, boxes[0], record=tmp_path / "run.rec")


def test_a_run_continues_if_its_recording_cannot_be_written(long_video, tmp_path, monkeypatch):
    path, boxes = long_video
    preload = tmp_path / "sitecustomize.py"
    preload.write_text("import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (5 << 20, resource.RLIM_INFINITY))")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with Pipeline(path, boxes[0], Settings(coreset={"size": 8}), record=tmp_path / "run.rec") as pipeline:
        assert len(list(pipeline)) == pipeline.frames
        assert pipeline.health["compressor"]["unrecorded"] == 1
        assert "cannot record" in pipeline.trouble["compressor"]
    recording = Recording(tmp_path / "run.rec")
    assert 0 < recording.counts[Features] < pipeline.frames
    assert recording.missing[Features] == pipeline.frames - recording.counts[Features], "the end was still written"
    assert not recording.complete
    assert recording.torn == 0

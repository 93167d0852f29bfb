"""The files from which a run continues on another machine."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import pytest

from catstream.errors import ServiceError
from catstream.pipeline import Pipeline
from catstream.run.state import files, position, restore
from catstream.services.desired import DESIRED, DesiredState
from catstream.settings import Settings


@pytest.fixture
def state(video, tmp_path):
    path, truth = video
    with Pipeline(path, truth[0], {"run.lockstep": True}, part=slice(0, 12), state=tmp_path / "here") as pipeline:
        assert len(list(pipeline)) == 12
    return tmp_path / "here"


def test_a_restored_state_is_at_the_same_position(state, tmp_path):
    content = files(state)
    restore(tmp_path / "there", content)
    assert Pipeline(resume=tmp_path / "there").frames == 12
    assert {"job.safetensors", "desired_state.json"} < content.keys()
    assert files(tmp_path / "there") == content
    assert position(tmp_path / "there").seq == 12


def test_a_run_is_resumed_with_all_settings_that_are_given_also_if_they_are_the_defaults(state):
    assert Pipeline(resume=state).settings.run.lockstep
    assert Pipeline(resume=state, settings={"run.lag_frames": 3}).settings.run.lockstep
    assert Pipeline(resume=state, settings=Settings()).settings == Settings()


def test_a_folder_without_a_checkpoint_has_no_files(tmp_path):
    assert files(tmp_path) == {}


@pytest.mark.parametrize("name", ["../other", "trees/../../other", "/etc/passwd", "trees/1.safetensors.part"])
def test_a_file_that_is_not_of_a_state_is_not_written(name, tmp_path):
    with pytest.raises(ServiceError, match="not a file of the state"):
        restore(tmp_path, {name: b""})
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_was_paused_or_has_no_object_left_says_so_when_it_is_resumed(state):
    assert Pipeline(resume=state).holding == ""
    desired = DesiredState.load(state / DESIRED)
    replace(desired, paused=True).save(state / DESIRED)
    assert Pipeline(resume=state).holding == "paused"
    replace(desired, objects={}).save(state / DESIRED)
    assert Pipeline(resume=state).holding == "waiting"


def test_a_run_whose_program_has_left_it_resumes_with_the_next_frame_without_a_difference(video, tmp_path, until):
    path, truth = video
    settings, whole = {"run.lockstep": True}, []
    with Pipeline(path, truth[0], settings) as pipeline:
        whole += pipeline
    trained = next(n for n in range(8, len(whole)) if whole[n].model_version < whole[n + 1].model_version)
    with Pipeline(path, truth[0], settings, state=tmp_path / "state") as pipeline:
        before = [*islice(pipeline, trained)]
        until(lambda: pipeline._reader._incoming.pending())
    assert position(tmp_path / "state").seq == trained + 1, "the checkpoint is ahead"
    with Pipeline(resume=tmp_path / "state") as pipeline:
        assert before + list(pipeline) == whole


def test_a_program_that_is_slower_than_the_detector_misses_no_frame_when_it_resumes(video, tmp_path, until):
    path, truth = video
    with Pipeline(path, truth[0], state=tmp_path / "state") as pipeline:
        first = next(iter(pipeline))
        until(lambda: position(tmp_path / "state").seq > 9)
    with Pipeline(resume=tmp_path / "state") as pipeline:
        assert [first.frame, *(track.frame for track in pipeline)] == list(range(len(truth)))


def test_a_frame_of_which_a_program_has_not_received_all_tracks_is_repeated_when_it_resumes(video, tmp_path):
    path, truth = video
    with Pipeline(path, {"anna": truth[0], "ben": truth[0]}, state=tmp_path / "state") as pipeline:
        before = [*islice(pipeline, 2 * 8 + 1)]
    with Pipeline(resume=tmp_path / "state") as pipeline:
        after = [(track.frame, track.object) for track in pipeline]
    assert (before[-1].frame, before[-1].object) == after[0]
    assert after == [(frame, name) for frame in range(8, len(truth)) for name in ("anna", "ben")]


def test_a_model_that_could_not_be_saved_is_an_error_before_the_run(video, tmp_path):
    with pytest.raises(ServiceError, match="none/anna: give a file in a folder that exists"):
        Pipeline(video[0], video[1][0], save_model=tmp_path / "none" / "anna")

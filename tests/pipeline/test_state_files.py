"""The files from which a run continues on another machine."""

from __future__ import annotations

from dataclasses import replace

import pytest

from catstream.errors import ServiceError
from catstream.pipeline import Pipeline
from catstream.run.state import files, position, restore, skip
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


@pytest.mark.parametrize(("known", "frames"), [(10, 30), (20, 22)])
def test_numbers_go_on_after_the_frames_that_were_lost(state, known, frames):
    settings = Pipeline(resume=state).settings
    assert skip(state, settings, known, frames) == 30, "the checkpoint is of message 12"
    assert (position(state).seq, position(state).frame) == (42, 41)


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


def test_a_model_that_could_not_be_saved_is_an_error_before_the_run(video, tmp_path):
    with pytest.raises(ServiceError, match="none/anna: give a file in a folder that exists"):
        Pipeline(video[0], video[1][0], save_model=tmp_path / "none" / "anna")

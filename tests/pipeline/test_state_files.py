"""The files from which a run continues on another machine."""

import shutil
from dataclasses import replace
from itertools import islice

import pytest

from catstream.errors import ServiceError
from catstream.pipeline import Pipeline
from catstream.processes.decisions import DesiredState
from catstream.processes.state import DESIRED, files, position, restore
from catstream.video.live_demo import first_box


@pytest.fixture(scope="module")
def finished(video, tmp_path_factory):
    path, truth = video
    folder = tmp_path_factory.mktemp("finished") / "state"
    with Pipeline(path, truth[0], {"run.lockstep": True}, part=slice(0, 12), state=folder) as pipeline:
        assert len(list(pipeline)) == 12
    return folder


@pytest.fixture
def state(finished, tmp_path):
    """The state of a run of 12 frames that has ended."""
    return shutil.copytree(finished, tmp_path / "here")


def test_restored_state_is_at_the_same_position(state, tmp_path):
    assert files(tmp_path) == {}, "there is no checkpoint"
    content = files(state)
    restore(tmp_path / "there", content)
    assert Pipeline(resume=tmp_path / "there").frames == 12
    assert {"job.safetensors", "desired_state.json"} < content.keys()
    assert files(tmp_path / "there") == content
    assert position(tmp_path / "there")[0] == 12


@pytest.mark.parametrize("name", ["../other", "searched_models/../x", "/etc/passwd", "trees/1.safetensors.part"])
def test_file_that_is_not_of_a_state_is_not_written(name, tmp_path):
    with pytest.raises(ServiceError, match="not a file of the state"):
        restore(tmp_path, {name: b""})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("changed", "held"), [({"paused": True}, "paused"), ({"objects": {}}, "waiting")])
def test_resumed_run_stays_paused_or_waits_for_a_box(video, tmp_path, until, changed, held):
    path, truth = video
    with Pipeline(path, truth[0], {"run.unstored_frames": 4}, state=tmp_path) as pipeline:
        next(iter(pipeline))  # and not to its end
    replace(DesiredState.load(tmp_path / DESIRED), **changed).save(tmp_path / DESIRED)
    with Pipeline(resume=tmp_path) as pipeline:
        until(lambda: pipeline.holding == held)
        assert next(pipeline.by_frame(0.1)) == {}


@pytest.mark.parametrize("changed", [{"paused": True}, {"objects": {}}])
def test_resumed_run_without_frames_ends(state, changed):
    replace(DesiredState.load(state / DESIRED), **changed).save(state / DESIRED)
    with Pipeline(resume=state) as pipeline:
        assert list(pipeline) == []
    assert (pipeline.reason, pipeline.totals["stored"]) == ("the source has ended", 12)


@pytest.mark.parametrize("lockstep", [False, True])
def test_resumed_run_continues_after_the_last_whole_frame(video, tmp_path, until, lockstep):
    path, truth = video
    boxes, settings = {"anna": truth[0], "ben": truth[0]}, {"run.lockstep": lockstep}
    with Pipeline(path, boxes, settings, state=tmp_path / "state") as pipeline:
        before = [*islice(pipeline, 2 * 8 + 1)]
        until(lambda: position(tmp_path / "state")[0] > 9)  # the checkpoint is ahead
    with Pipeline(resume=tmp_path / "state", after=before[-1].frame - 1) as pipeline:
        after = list(pipeline)
    missing = [(frame, name) for frame in range(8, len(truth)) for name in boxes]
    assert [(track.frame, track.object) for track in after] == missing
    hits = [track.box is not None and track.box.overlap(truth[track.frame]) > 0.5 for track in after]
    assert sum(hits) > 0.8 * len(hits)
    assert pipeline.totals["stored"] == pipeline.totals["sent"] == len(truth)


def test_model_without_a_folder_is_an_error_before_the_run(video, tmp_path):
    with pytest.raises(ServiceError, match=r"none/anna \(No such file or directory\): pass a file in"):
        Pipeline(video[0], video[1][0], save_model=tmp_path / "none" / "anna")


def test_resumed_live_run_continues_its_frames_and_times(tmp_path):
    """The log is ahead of the newest checkpoint on disk, by up to a minute."""
    state, settings = tmp_path / "state", {"run.checkpoint_seconds": 0.1}
    with Pipeline("demo:1", first_box("demo:1"), settings, state=state) as pipeline:
        tracks = iter(pipeline)
        while position(state)[0] < 10:
            next(tracks)
        older = files(state)
        *_, last = islice(tracks, 60)
    shutil.rmtree(state / "trees")
    restore(state, {name: data for name, data in older.items() if name.startswith("trees/")})
    assert position(state)[0] < last.frame
    pipeline = Pipeline(resume=state, after=last.frame)
    pipeline.first_time = last.time
    with pipeline:
        again = list(islice(pipeline, 5))
    assert [track.frame for track in again] == list(range(last.frame + 1, last.frame + 6))
    assert again[0].time > last.time
    assert again[0].model_version > 0, "the models were restored"

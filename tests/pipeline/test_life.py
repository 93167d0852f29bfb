"""A pipeline in a program: with `with` and without, more than once, and in threads."""

import gc
from concurrent.futures import ThreadPoolExecutor

import pytest

from catstream.base.settings import Settings
from catstream.errors import ServiceError
from catstream.pipeline import Pipeline

SETTINGS = Settings(run={"unstored_frames": 4})
PART = slice(0, 20)


@pytest.fixture
def pipeline(video):
    """A new one, of a few frames."""
    path, boxes = video
    return Pipeline(path, str(boxes[0]), SETTINGS, part=PART)


def test_pipeline_iterated_without_with_leaves_no_process(pipeline):
    assert (pipeline.pids, pipeline.restarts, pipeline.health) == ({}, 0, {})
    with pytest.raises(ServiceError, match="no endpoint before it has started"):
        _ = pipeline.endpoint
    tracks = list(pipeline)
    assert [track.frame for track in tracks] == list(range(20))
    versions = [track.model_version for track in tracks]
    assert versions == sorted(versions)
    assert [pipeline.totals[name] for name in ("sent", "stored", "rows")] == [20, 20, 20]
    assert not pipeline.pids
    with pytest.raises(ServiceError, match="a pipeline runs once"):
        next(iter(pipeline))


def test_loop_that_is_left_ends_the_run(pipeline, alive):
    pids, first = [], None
    for track in pipeline:
        pids, first = list(pipeline.pids.values()), track
        break
    gc.collect()
    assert len(pids) == 3
    assert not any(map(alive, pids))
    assert repr(first).startswith("Track(frame=0, time=0.000, state='bootstrapping', box=(")


def test_pipeline_is_iterated_in_parts_inside_a_with(pipeline):
    with pipeline:
        first = next(iter(pipeline))
        assert [first.frame, *(track.frame for track in pipeline)] == list(range(20))
    with pytest.raises(ServiceError, match="a pipeline runs once"):
        pipeline.__enter__()


def test_program_may_change_its_folder_during_a_run(video, tmp_path, monkeypatch):
    path, boxes = video
    begin, later = tmp_path / "begin", tmp_path / "later"
    begin.mkdir()
    later.mkdir()
    monkeypatch.chdir(begin)
    files = {"state": "state", "save_model": "m.safetensors"}
    with Pipeline(path, boxes[0], SETTINGS, part=PART, **files) as pipeline:
        monkeypatch.chdir(later)
        assert len(list(pipeline)) == 20
    assert pipeline.saved_models == [begin / "m.safetensors"]
    assert {file.name for file in begin.iterdir()} == set(files.values())
    assert not list(later.iterdir())


def test_pipeline_that_is_never_closed_causes_a_warning_and_ends(video, alive):
    path, boxes = video
    forgotten = Pipeline(path, boxes[0], SETTINGS, part=PART).__enter__()
    pids = list(forgotten.pids.values())
    with pytest.warns(ResourceWarning, match="was not closed"):
        del forgotten
    assert not any(map(alive, pids))


def test_loop_ends_if_another_thread_closes_the_pipeline(video, until):
    with ThreadPoolExecutor() as pool, Pipeline(video[0], settings=SETTINGS) as waiting:  # without a box no track comes
        loop = pool.submit(list, waiting)
        until(lambda: waiting.health)
        waiting.close()
        with pytest.raises(ServiceError, match="the pipeline is closed"):
            loop.result()

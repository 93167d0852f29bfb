"""A pipeline in a program: with `with` and without, more than once, and in threads."""

import gc
import re
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
    assert [track.frame for track in pipeline] == list(range(20))
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (20, 20)
    assert not pipeline.pids
    with pytest.raises(ServiceError, match="a pipeline runs once"):
        next(iter(pipeline))


def test_a_loop_that_is_left_ends_the_run(pipeline, alive):
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
        with pytest.raises(ServiceError, match="a pipeline runs once"), pipeline:
            pass
    for again in (lambda: next(iter(pipeline)), pipeline.__enter__):
        with pytest.raises(ServiceError, match="make another Pipeline"):
            again()


def test_a_program_may_change_its_folder_during_a_run(video, tmp_path, monkeypatch):
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


def test_every_attribute_in_the_docstring_exists(pipeline):
    section = Pipeline.__doc__.split("    Attributes\n")[1].split("\n\n")[0]
    names = [
        name
        for line in re.findall(r"^ {4}(\w.*)", section, re.MULTILINE)
        for name in re.findall(r"\w+", line.partition(" :")[0])
    ]
    assert "first_frame" in names
    assert [name for name in names if not hasattr(pipeline, name)] == []


def test_pipeline_that_is_never_closed_causes_a_warning_and_ends(video, alive):
    path, boxes = video
    forgotten = Pipeline(path, boxes[0], SETTINGS, part=PART).__enter__()
    pids = list(forgotten.pids.values())
    with pytest.warns(ResourceWarning, match="was not closed"):
        del forgotten
    assert not any(map(alive, pids))


def test_a_loop_ends_with_an_error_if_another_thread_closes_the_pipeline(video, until):
    with ThreadPoolExecutor() as pool, Pipeline(video[0], settings=SETTINGS) as waiting:  # without a box no track comes
        loop = pool.submit(list, waiting)
        until(lambda: waiting.health)
        waiting.close()
        with pytest.raises(ServiceError, match="the pipeline is closed"):
            loop.result()

"""A pipeline in a program: with `with` and without, more than once, and in an event loop."""

from __future__ import annotations

import asyncio
import copy
import gc
import json
import pickle
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from catstream.errors import ServiceError
from catstream.pipeline import Pipeline
from catstream.services import run_reader
from catstream.services.supervisor import Supervisor
from catstream.settings import Settings
from catstream.video.live_demo import first_box

SETTINGS = Settings(run={"unstored_frames": 4})
PART = slice(0, 20)


@pytest.fixture
def pipeline(video):
    """A new one, of a few frames."""
    path, boxes = video
    return Pipeline(path, str(boxes[0]), SETTINGS, part=PART)


def test_it_is_iterated_without_with_and_leaves_no_process(pipeline):
    assert [track.frame for track in pipeline] == list(range(20))
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (20, 20)
    assert not pipeline.pids
    with pytest.raises(ServiceError, match="a pipeline runs once"):
        next(iter(pipeline))


def test_a_detector_that_has_ended_with_the_stream_is_no_failure(pipeline, monkeypatch, until):
    check = Supervisor.check_children

    def check_late(supervisor, **facts):
        if pipeline.totals:  # the end was received: the detector may end before it is looked at
            until(lambda: supervisor.finished)
        check(supervisor, **facts)

    monkeypatch.setattr(Supervisor, "check_children", check_late)
    monkeypatch.setattr(run_reader, "TURN_SECONDS", 0)
    assert [track.frame for track in pipeline] == list(range(20))


def test_a_loop_that_is_left_ends_the_run(pipeline, alive):
    pids, first = [], None
    for track in pipeline:
        pids, first = list(pipeline.pids.values()), track
        break
    gc.collect()
    assert len(pids) == 3
    assert not any(map(alive, pids))
    prints_well_and_is_ready_for_json(first)


def test_in_a_with_it_is_iterated_piece_by_piece_and_afterwards_no_more(pipeline):
    with pipeline:
        first = next(iter(pipeline))
        assert [first.frame, *(track.frame for track in pipeline)] == list(range(20))
        with pytest.raises(ServiceError, match="a pipeline runs once"), pipeline:
            pass
    for again in (lambda: next(iter(pipeline)), pipeline.__enter__):
        with pytest.raises(ServiceError, match="make another Pipeline"):
            again()


def test_a_file_address_is_stored_as_a_path_from_which_a_run_can_resume(video):
    path, boxes = video
    assert Pipeline(Path(path).as_uri(), str(boxes[0])).source == str(path)


def test_a_program_may_change_its_folder_during_a_run(video, tmp_path, monkeypatch):
    path, boxes = video
    begin, later = tmp_path / "begin", tmp_path / "later"
    begin.mkdir()
    later.mkdir()
    monkeypatch.chdir(begin)
    files = {"state": "state", "record": "run.mcap", "save_model": "m.safetensors"}
    with Pipeline(path, boxes[0], SETTINGS, part=PART, **files) as pipeline:
        monkeypatch.chdir(later)
        assert len(list(pipeline)) == 20
    assert pipeline.saved_models == [begin / "m.safetensors"]
    assert {file.name for file in begin.iterdir()} == set(files.values())
    assert not list(later.iterdir())


def test_before_its_start_a_pipeline_has_no_processes_and_no_endpoint(pipeline):
    assert (pipeline.pids, pipeline.restarts, pipeline.health) == ({}, 0, {})
    with pytest.raises(ServiceError, match="no endpoint before it has started"):
        _ = pipeline.endpoint


@pytest.mark.parametrize("made", [lambda it: it.starting_after(None), copy.copy, copy.deepcopy, pickle.dumps])
def test_a_pipeline_is_copied_before_its_start_only(pipeline, made):
    made(pipeline)
    with pipeline:
        with pytest.raises(ServiceError, match="before that"):
            made(pipeline)
        assert len(list(pipeline)) == 20


@pytest.mark.timeout(60)
def test_a_run_of_a_live_source_is_resumed_with_its_first_frame(tmp_path):
    """The second frame would come after 100 s."""
    source = "demo:1"
    with Pipeline(source, first_box(source), {"run.image_rate": 0.01}, state=tmp_path / "kept") as pipeline:
        before = next(iter(pipeline))
    with Pipeline(resume=tmp_path / "kept") as pipeline:
        assert next(iter(pipeline)).frame == before.frame + 1


def test_a_pipeline_that_is_never_closed_causes_a_warning_and_ends(video, alive):
    path, boxes = video
    forgotten = Pipeline(path, boxes[0], SETTINGS, part=PART).__enter__()
    pids = list(forgotten.pids.values())
    with pytest.warns(ResourceWarning, match="was not closed"):
        forgotten = None
    assert forgotten is None
    assert not any(map(alive, pids))


def test_a_pipeline_that_is_never_closed_ends_also_if_a_warning_is_an_error(video, alive, monkeypatch):
    path, boxes = video
    forgotten = Pipeline(path, boxes[0], SETTINGS, part=PART).__enter__()
    pids, errors = list(forgotten.pids.values()), []
    monkeypatch.setattr(sys, "unraisablehook", lambda raised: errors.append(raised.exc_type))
    with warnings.catch_warnings(action="error"):
        forgotten = None
    assert forgotten is None
    assert errors == [ResourceWarning]
    assert not any(map(alive, pids))


@pytest.mark.parametrize("enter", [True, False])
def test_an_event_loop_continues_while_it_waits_for_tracks(pipeline, enter):
    async def follow():
        return [track.frame async for track in pipeline]

    async def run():
        turns = asyncio.create_task(count())
        if enter:
            async with pipeline:
                frames = await follow()
        else:
            frames = await follow()
        turns.cancel()
        return frames

    ticks = 0

    async def count():
        nonlocal ticks
        while True:
            await asyncio.sleep(0)
            ticks += 1

    assert asyncio.run(run()) == list(range(20))
    assert ticks > 20
    assert not pipeline.pids


def test_a_task_that_is_cancelled_ends_the_run_in_order(video, alive):
    pids = []

    async def follow():
        async with Pipeline(video[0], settings=SETTINGS) as waiting:  # without a box no track comes
            pids.extend(waiting.pids.values())
            begun.set()
            async for _ in waiting:
                raise AssertionError

    async def run():
        task = asyncio.create_task(follow())
        await begun.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    begun = asyncio.Event()
    asyncio.run(run())
    assert len(pids) == 3
    assert not any(map(alive, pids))


@pytest.mark.parametrize("task", [False, True], ids=["thread", "task"])
def test_a_loop_ends_with_an_error_if_another_thread_or_task_closes_the_pipeline(video, until, task):
    def follow():
        if task:
            asyncio.run(follow_in_a_task())
        else:
            list(waiting)

    async def follow_in_a_task():
        async for _ in waiting:
            raise AssertionError

    with ThreadPoolExecutor() as pool, Pipeline(video[0], settings=SETTINGS) as waiting:  # without a box no track comes
        loop = pool.submit(follow)
        until(lambda: waiting.health)  # the loop has received it
        waiting.close()
        with pytest.raises(ServiceError, match="the pipeline was closed, perhaps by another thread or task"):
            loop.result()


def prints_well_and_is_ready_for_json(track):
    """What a person sees of a track, and a program in another language."""
    assert repr(track).startswith("Track(frame=0, time=0.000, state='bootstrapping', box=(")
    assert json.loads(json.dumps(track.to_dict())) == {
        "seq": 1,
        "frame": 0,
        "time": 0.0,
        "state": "bootstrapping",
        "box": list(track.box),
        "score": track.score,
        "model_version": 0,
        "pts": None,
        "object": "",
        "began": 0,
    }

"""A stream of a fleet without Ray: its pipeline, its state in the store, and its end."""

from __future__ import annotations

from contextlib import contextmanager

import pytest

from catstream.box import Box
from catstream.errors import StoreError
from catstream.fleet.spec import StreamSpec
from catstream.fleet.store import Claim, Store
from catstream.fleet.stream import Place, Stream

FRAMES = 60


@pytest.fixture
def store(tmp_path):
    (tmp_path / "store").mkdir()
    return (tmp_path / "store").as_uri()


@pytest.fixture
def spec(demo_video):
    path, truth = demo_video(FRAMES)
    return StreamSpec("cam-7", str(path), {"": Box(*truth[0])}, settings={"run.lockstep": True})


@pytest.fixture
def long_spec(demo_video):
    """A stream that runs for seconds after the store fails."""
    path, truth = demo_video(400)
    return StreamSpec("cam-7", str(path), {"": Box(*truth[0])}, settings={"run.lockstep": True})


@contextmanager
def started(spec, store, node="n1", every=0.2):
    stream = Stream(spec, Place(node), store, every)
    try:
        yield stream
    finally:
        stream.stop()


def test_a_stream_runs_to_its_end_and_its_state_is_stored(spec, store, until):
    with started(spec, store) as stream:
        until(lambda: stream.report().status.state == "ended")
    status = stream.report().status
    assert (status.node, status.frame, status.trouble) == ("n1", FRAMES - 1, "")
    state = Store(store).newest("cam-7")
    assert (state.facts["ended"], state.facts["seq"]) == (True, FRAMES)


def test_a_stream_continues_on_another_node_where_it_was(spec, store, until):
    with started(spec, store) as first:
        until(lambda: first.report().status.frame >= 10)
    before = Store(store).newest("cam-7").facts["seq"]
    with started(spec, store, "n2") as second:
        until(lambda: second.report().status.state == "ended")
    after = second.report().status
    assert 10 <= before < FRAMES
    assert after.token > first.report().status.token
    assert Store(store).newest("cam-7").facts["seq"] == FRAMES


def test_a_holder_that_was_replaced_stops_and_stores_nothing(spec, store, until):
    with started(spec, store) as old:
        until(lambda: old.report().status.frame >= 3)
        claim = Store(store).claim("cam-7", "another node")
        until(lambda: old.report().fenced)
    assert Store(store).newest("cam-7") == claim.state


def test_a_stream_that_has_ended_is_not_run_again(spec, store, until):
    for _ in range(2):
        with started(spec, store) as stream:
            until(lambda: stream.report().status.state == "ended")
    assert stream.report().status.endpoint == ""


def test_a_source_that_cannot_be_opened_is_named(store, until, tmp_path):
    with started(StreamSpec("cam-8", str(tmp_path / "none.mp4")), store) as stream:
        until(lambda: stream.report().status.state == "failed")
    report = stream.report()
    assert report.source_failed
    assert "none.mp4" in report.status.trouble


def test_a_stream_goes_on_while_the_store_takes_nothing(long_spec, store, until, monkeypatch):
    def fails(*_):
        raise StoreError("the store cannot be reached")

    with started(long_spec, store) as stream:
        until(lambda: stream.report().status.frame >= 3)
        with monkeypatch.context() as patch:
            patch.setattr(Claim, "write", fails)
            until(lambda: "cannot be stored: the store cannot be reached" in stream.report().status.trouble)
            frame = stream.report().status.frame
            until(lambda: stream.report().status.frame > frame)
        until(lambda: stream.report().status.trouble == "")


def test_a_stream_has_ended_only_once_its_last_state_is_stored(spec, store, until, monkeypatch):
    written, write = [], Claim.write

    def fails_at_first(claim, files, facts):
        if facts["ended"]:
            written.append(stream.report().status.state)
        if len(written) == 1:
            raise StoreError("the store cannot be reached")
        write(claim, files, facts)

    monkeypatch.setattr(Claim, "write", fails_at_first)
    with started(spec, store) as stream:
        until(lambda: stream.report().status.state == "ended")
    assert written == ["running", "running"]
    assert Store(store).newest("cam-7").facts["ended"]

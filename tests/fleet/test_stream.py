"""A stream of a fleet without Ray: its pipeline, its state in the store, and its end."""

from __future__ import annotations

import threading
from collections import defaultdict
from contextlib import contextmanager
from dataclasses import replace

import pytest

from catstream.box import Box
from catstream.errors import StoreError
from catstream.fleet import stream as module
from catstream.fleet.life import Order
from catstream.fleet.spec import StreamSpec
from catstream.fleet.store import Claim, Store
from catstream.fleet.stream import Place, Stream
from catstream.run.state import position, skip
from catstream.video.live_demo import first_box

FRAMES = 60
LIVE = "demo:1"


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
def started(spec, store, node="n1", every=0.2, address=""):
    stream = Stream(spec, Order(spec.digest, 1.0, {}), Place(node, address), store, every)
    try:
        yield stream
    finally:
        stream.stop()


def test_a_stream_runs_to_its_end_and_its_state_is_stored(spec, store, until):
    with started(spec, store) as stream:
        until(lambda: stream.report().status.state == "ended")
    status = stream.report().status
    assert (status.node, status.frame, status.trouble) == ("n1", FRAMES - 1, "")
    state = Store(store).stream("cam-7").newest()
    assert (state.facts["end"], state.facts["seq"]) == ("ended", FRAMES)


def test_a_stream_continues_on_another_node_where_it_was(spec, store, until):
    with started(spec, store) as first:
        until(lambda: first.report().status.frame >= 10)
    before = Store(store).stream("cam-7").newest().facts["seq"]
    with started(spec, store, "n2") as second:
        until(lambda: second.report().status.state == "ended")
    after = second.report().status
    assert 10 <= before < FRAMES
    claimed, *_, tracked = [line.partition(" info ")[2] for line in second.logs(100) if " info " in line]
    assert claimed == f"cam-7: claimed with token {after.token}, after frame {before - 1}"
    assert tracked == "cam-7: the first frame is tracked"
    assert after.token > first.report().status.token
    assert Store(store).stream("cam-7").newest().facts["seq"] == FRAMES


def test_a_holder_that_was_replaced_stops_and_nobody_reads_its_states_any_more(spec, store, until):
    with started(spec, store) as old:
        until(lambda: old.report().status.frame >= 3)
        claim = Store(store).stream("cam-7").claim("another node")
        until(lambda: old.report().superseded)
    assert Store(store).stream("cam-7").newest().token < claim.token
    claim.write({"state": b"newer"}, {"end": ""})
    assert Store(store).stream("cam-7").newest().files == {"state": b"newer"}


def test_a_stream_that_has_ended_is_not_run_again(spec, store, until):
    for _ in range(3):
        with started(spec, store) as stream:
            until(lambda: stream.report().status.state == "ended")
    status = stream.report().status
    assert (status.endpoint, status.restarts) == ("", 0)
    assert status.stored_seconds is not None


def test_a_stream_that_has_ended_and_was_changed_begins_anew(spec, store, until):
    for each in (spec, replace(spec, settings=spec.settings | {"coreset.size": 32})):
        with started(each, store) as stream:
            until(lambda: stream.report().status.state == "ended")
    assert stream.report().status.frame == FRAMES - 1
    assert stream.report().status.began > 0


@pytest.mark.parametrize("address", ["", "127.0.0.1"], ids=["one machine", "with keys"])
def test_a_source_that_cannot_be_opened_is_named_and_tried_again(spec, store, until, tmp_path, monkeypatch, address):
    monkeypatch.setattr(module, "FIRST_PAUSE_SECONDS", 0.1)
    path = tmp_path / "late.mp4"
    with started(replace(spec, source=str(path)), store, address=address) as stream:
        until(lambda: stream.report().status.state == "failed")
        assert "late.mp4" in stream.report().status.trouble
        assert any("late.mp4" in line for line in stream.logs(10)), "the log stays"
        path.symlink_to(spec.source)
        until(lambda: stream.report().status.state == "ended")
    report = stream.report()
    assert report.status.restarts >= 1
    assert (report.status.trouble, report.superseded) == ("", False)


def test_a_store_that_the_node_cannot_use_is_named(spec, until):
    with started(spec, "s3://Not_a_bucket") as stream:
        until(lambda: stream.report().status.state == "failed")
        assert "the URL of the store is not valid" in stream.report().status.trouble


def test_followed_objects_are_searched_for_by_the_newest_merged_model_once_they_are_absent(
    long_spec, store, until, monkeypatch
):
    """However many models are merged meanwhile, each is searched for once, and without a thread of its own."""
    searched = []
    monkeypatch.setattr(Stream, "_search", lambda _, __, model, name: searched.append((name, model.files["model"])))
    threads = threading.active_count()
    with started(replace(long_spec, follow=("anna",)), store, every=0.05) as stream:
        until(lambda: stream.report().status.frame >= 3)
        for number in range(20):
            Store(store).model("anna").put({"model": b"model %d" % number}, {})
        until(lambda: searched and searched[-1] == ("anna", b"model 19"))
        assert threading.active_count() < threads + 20
        found = len(searched)
        stream.report(follow=())
        until(lambda: not stream._follow)
        Store(store).model("anna").put({"model": b"not followed"}, {})
    assert [name for name, _ in searched] == ["anna"] * len(searched)
    assert searched[found:] == []


def test_a_slow_stream_says_so():
    rates = module._Rates(since=0.0, frames=60)
    rates.update(lambda: 2.0, skipped=40)
    assert rates.trouble.startswith("it skips 40% of its frames with ")
    rates = module._Rates(since=0.0, frames=60)
    rates.update(lambda: 2.0, skipped=2)
    assert rates.trouble == ""


def test_a_stream_that_waits_for_a_box_skips_frames_on_purpose(store, until, monkeypatch):
    monkeypatch.setattr(module, "RATE_SECONDS", 0.1)
    with started(StreamSpec("cam-7", LIVE), store) as stream:
        until(lambda: stream.report().status.skipped > 2)
        status = stream.report().status
    assert (status.state, status.trouble) == ("waiting", "")


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
        monkeypatch.setattr(Claim, "write", fails)
        assert stream.stop() == "its state cannot be stored: the store cannot be reached"


def test_a_stream_has_ended_only_once_its_last_state_is_stored(spec, store, until, monkeypatch):
    written, write = [], Claim.write

    def fails_at_first(claim, files, facts):
        if facts["end"]:
            written.append(stream.report().status.state)
        if len(written) == 1:
            raise StoreError("the store cannot be reached")
        write(claim, files, facts)

    monkeypatch.setattr(Claim, "write", fails_at_first)
    with started(spec, store) as stream:
        until(lambda: stream.report().status.state == "ended")
    assert written == ["running", "running"]
    assert Store(store).stream("cam-7").newest().facts["end"] == "ended"


@pytest.fixture
def live_spec():
    return StreamSpec("gate", LIVE, {"": first_box(LIVE)})


@pytest.fixture
def numbers(monkeypatch):
    """The numbers of the frames that each stream has tracked, by its node."""
    found, take = defaultdict(list), Stream._take

    def took(stream, pipeline, tracks):
        take(stream, pipeline, tracks)
        found[stream._place.node] += [track.seq for track in tracks.values()]

    monkeypatch.setattr(Stream, "_take", took)
    return found


def test_after_a_death_the_lost_frames_are_those_after_the_last_state_and_it_counts_as_a_restart(
    live_spec, store, until, numbers, monkeypatch
):
    continued = []
    monkeypatch.setattr(
        module, "skip", lambda state, *given: continued.append(position(state).seq) or skip(state, *given)
    )
    with started(live_spec, store, every=0.5) as first:
        until(lambda: (found := Store(store).stream("gate").newest()) is not None and found.facts["seq"] > 5)
        with started(live_spec, store, "n2", every=60.0) as second:  # as if the first node had died
            until(lambda: first.report().superseded)
            until(lambda: numbers["n2"])
            later = second.report().status
    assert later.stored_seconds is not None, "that of the state that it continued from"
    assert (first.report().status.restarts, later.restarts) == (0, 1)
    (stored,) = continued
    assert numbers["n2"][0] == stored + later.lost_frames + 1, "no other number is left out"
    assert not set(numbers["n1"]) & set(numbers["n2"])


@pytest.mark.parametrize(("end", "is_lost"), [("moved", True), ("stopped", False)])
def test_a_move_loses_frames_and_the_time_in_which_the_fleet_is_down_does_not(
    live_spec, store, until, numbers, end, is_lost
):
    stream = Stream(live_spec, Order(live_spec.digest, 1.0, {}), Place("n1"), store, 60.0)
    until(lambda: len(numbers["n1"]) > 5)
    stream.stop(end)
    with started(live_spec, store, "n2") as second:
        until(lambda: numbers["n2"])
        status = second.report().status
    assert (status.lost_frames > 0, status.lost_seconds > 0) == (is_lost, is_lost)
    assert status.restarts == 0
    left_out = numbers["n2"][0] - numbers["n1"][-1] - 1
    assert 0 <= left_out - status.lost_frames <= 5, "only those that the pipeline tracked while it ended"

"""A stream of a fleet without Ray: its pipeline, its state in the store, and its end."""

import json
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import pytest

from catstream.base.box import Box
from catstream.client.attach import control
from catstream.errors import StoreError
from catstream.fleet import actor as module
from catstream.fleet.actor import Stream
from catstream.fleet.spec import StreamSpec
from catstream.fleet.store import Claim, Store
from catstream.video.live_demo import first_box
from catstream.wire import discovery
from catstream.wire.discovery import free_ports

FRAMES = 60
LIVE = "demo:1"


@pytest.fixture
def store(tmp_path):
    (tmp_path / "store").mkdir()
    return str(tmp_path / "store")


@pytest.fixture
def spec(demo_video):
    path, truth = demo_video(FRAMES)
    return StreamSpec("cam-7", str(path), {"": Box(*truth[0])}, settings={"run.lockstep": True})


@pytest.fixture
def recorded(monkeypatch):
    """The claims that write a state, and those that are checked, in two lists."""
    lists = [], []
    for name, calls in zip(("write", "check"), lists, strict=True):
        done = getattr(Claim, name)
        monkeypatch.setattr(Claim, name, lambda *given, done=done, calls=calls: calls.append(given) or done(*given))
    return lists


@contextmanager
def started(spec, store, node="n1", every=0.2, address=""):
    stream = Stream(spec, node, address, {}, store, every)
    try:
        yield stream
    finally:
        stream.stop()


def frames_of(path):
    """The numbers of the frames in a log, below its header."""
    return [json.loads(line)["frame"] for line in path.read_text().splitlines()[1:]]


def test_log_of_a_stream_is_continued_after_a_stop_and_a_torn_line(spec, store, until, tmp_path):
    log = tmp_path / "new" / "cam-7.ndjson"
    spec = replace(spec, write=(str(log), str(log.with_suffix(".csv"))))
    with started(spec, store) as first:
        until(lambda: first.report()[0].frame >= 10)
    with log.open("a") as file:
        file.write('{"frame": 60')  # as if power failed
    with started(spec, store) as second:
        until(lambda: second.report()[0].state == "ended")
    assert frames_of(log) == list(range(FRAMES))
    assert len(log.with_suffix(".csv").read_text().splitlines()) == FRAMES + 1


def test_live_stream_repeats_no_frame_number_of_its_log(store, until, tmp_path):
    spec = StreamSpec("gate", LIVE, {"": first_box(LIVE)}, write=(str(tmp_path / "gate.ndjson"),))
    with started(spec, store) as stream:
        until(lambda: Store(store).stream("gate").newest() is not None)
        stream._every = 60.0  # later states are not stored
        until(lambda: stream.report()[0].frame > 60)
        Store(store).stream("gate").claim()
        stream._superseded = True
    with started(spec, store, "n2") as stream:
        last = frames_of(tmp_path / "gate.ndjson")[-1]
        until(lambda: stream.report()[0].frame > last + 5)
    frames = frames_of(tmp_path / "gate.ndjson")
    assert frames == sorted(set(frames))


def test_ended_stream_runs_again_only_if_it_is_changed(spec, store, until):
    changed, reports = replace(spec, settings=spec.settings | {"coreset.size": 32}), []
    for each in (spec, spec, spec, changed):
        with started(each, store) as stream:
            until(lambda stream=stream: stream.report()[0].state == "ended")
        reports.append(stream.report()[0])
    assert [(each.node, each.frame, each.token) for each in reports] == [
        ("n1", FRAMES - 1, 1), ("n1", FRAMES - 1, 0), ("n1", FRAMES - 1, 0), ("n1", FRAMES - 1, 4),
    ]  # fmt: skip
    assert (reports[2].endpoint, reports[2].trouble) == ("", "")
    assert reports[2].stored_seconds is not None


def test_source_that_cannot_be_opened_is_named_and_retried(spec, store, until, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "FIRST_PAUSE_SECONDS", 0.1)
    path = tmp_path / "late.mp4"
    with started(replace(spec, source=str(path)), store, address="127.0.0.1") as stream:
        until(lambda: stream.report()[0].state == "failed")
        assert "late.mp4" in stream.report()[0].trouble
        path.symlink_to(spec.source)
        until(lambda: stream.report()[0].state == "ended")
    status, is_superseded = stream.report()
    assert (status.token > 1, status.trouble, is_superseded) == (True, "", False)


def test_paused_stream_uploads_nothing_and_notices_a_newer_claim(store, until, recorded):
    written, checked = recorded

    def uploads():
        before, end = len(written), len(checked) + 20
        until(lambda: len(checked) > end)
        return len(written) - before

    with started(StreamSpec("gate", LIVE, {"": first_box(LIVE)}), store, every=0.1) as stream:
        until(lambda: stream.report()[0].frame > 5)
        with control(stream.report()[0].endpoint) as controlled:
            controlled.pause()
        until(lambda: stream.report()[0].state == "paused")
        until(lambda: not uploads())  # the last checkpoint may follow
        assert (uploads(), stream.report()[0].trouble) == (0, "")
        Store(store).stream("gate").claim()
        until(lambda: stream.report()[1])


def test_upload_rate_is_limited_except_after_a_command_or_failure(store, until, monkeypatch, recorded):
    written, checked = recorded
    monkeypatch.setattr(module, "_CHECK_SECONDS", 0.1)
    monkeypatch.setattr(module, "_STORE_RATE", 1.0)  # bytes per second
    with started(StreamSpec("gate", LIVE, {"": first_box(LIVE)}), store, every=0) as stream:
        until(lambda: written)
        end = len(checked) + 30
        until(lambda: len(checked) > end)
        assert len(written) == 1
        with control(stream.report()[0].endpoint) as controlled:
            controlled.set_box("10,10,50,50", "other")
        until(lambda: len(written) == 2)
        last = stream.report()[0].frame
        until(lambda: stream.report()[0].frame > last + 100)
        monkeypatch.setattr(stream, "_update_status", lambda *_: 1 / 0)
        until(lambda: stream.report()[0].state == "failed")
        until(lambda: stream.report()[0].token == 2)
        assert Store(store).stream("gate").newest().facts["frame"] > last + 100


def test_lost_source_is_the_state_and_trouble_of_its_stream(store, camera, image, until):
    gate = camera(lambda _: image)
    with started(StreamSpec("gate", gate.url, {"": Box(60, 60, 80, 80)}), store) as stream:
        until(lambda: stream.report()[0].state == "running")
        assert stream.report()[0].present.keys() == {""}
        gate.leave()
        lost = until(lambda: (found := stream.report()[0]).state == "lost" and found)
    assert lost.trouble.startswith("its source has been lost for ")
    assert lost.present == {}, "where the object is, is not known"


def test_live_stream_continues_on_another_node_with_its_models(store, until):
    spec = StreamSpec("gate", LIVE, {"": first_box(LIVE)})

    def stored_at():
        newest = Store(store).stream("gate").newest()
        return newest and newest.facts["time"]

    with started(spec, store) as first:
        until(lambda: first.report()[0].models.get("", 0) > 5)  # at most one model is trained on a frame
        for _ in range(2):  # the checkpoint in the next state may be older
            before = stored_at()
            until(lambda before=before: stored_at() != before)
        with started(spec, store, "n2", every=60.0) as second:  # as if the first node had died
            until(lambda: first.report()[1])
            status = until(lambda: (found := second.report()[0]).state == "running" and found)
    assert status.frame > 5
    assert (status.live, max(status.models.values()) > 0) == (True, True)
    assert status.stored_seconds is not None, "that of the state that it continued from"


def test_streams_of_a_node_listen_on_different_ports(tcp, monkeypatch):
    first = int(tcp.rpartition(":")[2])
    blocks = range(first, first + 9, 3)
    monkeypatch.setattr(discovery, "PORTS", blocks)
    with ExitStack() as stack:
        assert sorted(free_ports("127.0.0.1", stack) for _ in blocks) == list(blocks)


def test_stream_continues_while_its_state_cannot_be_stored(store, until, monkeypatch):
    def fail(*_):
        raise StoreError("the store cannot be reached")

    with started(StreamSpec("gate", LIVE, {"": first_box(LIVE)}), store) as stream:
        until(lambda: stream.report()[0].frame >= 3)
        with monkeypatch.context() as patch:
            patch.setattr(Claim, "write", fail)
            until(lambda: "cannot be stored: the store cannot be reached" in stream.report()[0].trouble)
            frame = stream.report()[0].frame
            until(lambda: stream.report()[0].frame > frame)
        until(lambda: stream.report()[0].trouble == "")
        monkeypatch.setattr(Claim, "write", fail)
        assert stream.stop() == "its state cannot be stored: the store cannot be reached"


def test_stream_has_ended_once_its_last_state_is_stored(spec, store, until, monkeypatch):
    written, write = [], Claim.write

    def fails_at_first(claim, files, facts):
        if facts["ended"]:
            written.append(stream.report()[0].state)
        if len(written) == 1:
            raise StoreError("the store cannot be reached")
        write(claim, files, facts)

    monkeypatch.setattr(Claim, "write", fails_at_first)
    with started(spec, store) as stream:
        until(lambda: stream.report()[0].state == "ended")
    assert written == ["running", "running"]
    assert Store(store).stream("cam-7").newest().facts["ended"]

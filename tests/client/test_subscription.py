"""Subscriptions to a pipeline: the messages that arrive, the missed frames that are counted, and the end."""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import chain, repeat
from types import SimpleNamespace

import numpy as np
import pytest
import zmq

import catstream
from catstream.errors import ObjectError, ServiceError, SilenceError
from catstream.wire import socket
from catstream.wire.channels import HEALTH, MODELS, TRACKS
from catstream.wire.discovery import reserve_endpoint
from catstream.wire.messages import End, Features, Health, ObjectFeatures, TrainingRows
from catstream.wire.newest import GapCounter, Publisher
from tests.wire.examples import model
from tests.wire.examples import present as track


def features(seq):
    rows = np.full((2, 5), seq, np.float32)
    training = {"appearance": TrainingRows.labelled(rows, 0, seq)}
    return Features(seq - 1, 0.0, {"": ObjectFeatures(None, training)})


@pytest.fixture
def tracks(endpoint):
    """The detector's side: sends tracks."""
    with Publisher(TRACKS, endpoint) as publisher:
        yield publisher


@pytest.fixture
def attached(endpoint, tracks, until):
    """Makes a subscription to which the publisher of tracks is connected: it got the track with seq 1."""

    def subscribe(**options):
        subscription = catstream.subscribe(str(endpoint), "tracks", timeout=500, **options)
        until(lambda: len(tracks._subscribed) == 2, tracks.serve_late_joiners)  # the end has a connection of its own
        tracks.send(track(1, options.get("object", "")))
        assert next(subscription).seq == 1
        return subscription

    return subscribe


def test_closed_subscription_ends_loops_in_other_threads(attached):
    with attached() as subscription, ThreadPoolExecutor() as pool:
        loop = pool.submit(list, subscription)
        subscription.close()
        with pytest.raises(ServiceError, match="the subscription is closed"):
            loop.result()
        with pytest.raises(ServiceError, match="the subscription is closed"):
            next(subscription)


def test_gaps_are_counted_in_a_new_run_from_frame_zero():
    gaps = GapCounter()
    for run, frame in (("a", 7), ("a", 9), ("b", 0), ("b", 2)):
        gaps.take(SimpleNamespace(frame=frame), run)
    assert (gaps.before, gaps.missed) == (7, 2)


@pytest.mark.parametrize(
    ("sent", "end", "missed"),
    [
        pytest.param([("", seq) for seq in range(2, 50)], 49, 0, id="all"),
        pytest.param([("", 2), ("", 5), ("", 6), ("", 10)], 12, 2 + 3 + 2, id="gaps, also before the end"),
        pytest.param([("", seq) for seq in (2, 3, 4, 2, 3, 4, 5)], 5, 0, id="repeated by a restarted detector"),
        pytest.param([("", seq) for seq in (2, 3, 4, 5, 3, 6)], 6, 0, id="repeated in part"),
        pytest.param([("a", 2), ("b", 2), ("b", 3), ("a", 3), ("a", 6), ("b", 6)], 6, 2, id="several objects"),
    ],
)
def test_tracks_arrive_in_order_and_each_gap_is_counted(tracks, attached, sent, end, missed):
    with attached() as subscription:
        for name, seq in sent:
            tracks.send(track(seq, name))
        tracks.send(End(end, "the source has ended", totals={"sent": 49.0}))
        assert [(message.object, message.seq) for message in subscription] == sent
        assert (subscription.missed, subscription.end.totals) == (missed, {"sent": 49})
        assert list(subscription) == [], "it stays ended"


@pytest.mark.parametrize(
    ("sent", "missed"),
    [
        pytest.param([(40, 9), (41, 9), (42, 9)], 0, id="begins late, is forgotten early"),
        pytest.param([(40, 9), (43, 9), (44, 9)], 2, id="loses two"),
        pytest.param([(40, 9), (41, 9), (90, 89), (91, 89)], 0, id="begins again"),
        pytest.param([(40, 9), (42, 9), (90, 89), (92, 89)], 2, id="loses one in each life"),
    ],
)
def test_frames_before_and_after_an_object_are_not_missed(endpoint, tracks, until, sent, missed):
    with catstream.subscribe(str(endpoint), "tracks", object="anna", timeout=500) as subscription:
        until(lambda: len(tracks._subscribed) == 2, tracks.serve_late_joiners)  # the end has a connection of its own
        for seq, began in sent:
            tracks.send(track(seq, "annas"))
            tracks.send(replace(track(seq, "anna"), began=began))
        tracks.send(End(99, "the source has ended"))
        assert [(message.object, message.seq) for message in subscription] == [("anna", seq) for seq, _ in sent]
        assert subscription.losses() == f"{missed} missed", "and none before"


@pytest.mark.parametrize(
    ("channel", "name", "words"),
    [
        *((channel, "anna", "about all objects: subscribe to samples, models") for channel in ("features", "health")),
        ("tracks", "an na", "'an na' is not a name"),
        *((channel, None, "unknown channel") for channel in ("all-features", "results", "frames")),
    ],
)
def test_invalid_channel_or_object_is_an_error(endpoint, channel, name, words):
    with pytest.raises((ServiceError, ObjectError), match=words):
        catstream.subscribe(str(endpoint), channel, object=name)


@pytest.fixture
def small_buffers(monkeypatch):
    """Keeps the buffers of tcp from growing to many megabytes."""
    for option in (zmq.SNDBUF, zmq.RCVBUF):
        monkeypatch.setitem(socket._OPTIONS, option, 1 << 14)


@pytest.mark.usefixtures("small_buffers")
def test_subscriber_whose_end_message_was_dropped_ends(tracks, attached):
    count = 10_000  # more than all buffers on the way hold
    with attached() as subscription:
        for seq in range(2, count):
            tracks.send(track(seq))
        tracks.send(End(count - 1, "the source has ended"))
        received = len(list(subscription))
        assert 0 < received < count - 2, "this reader was too slow"
        assert received + subscription.missed == count - 2


def test_message_that_arrives_with_the_end_is_read(endpoint, tracks, until, monkeypatch):
    monkeypatch.setattr("catstream.client.subscription.DRAIN_SECONDS", 0.0)
    with (
        Publisher(MODELS, endpoint) as models,
        catstream.subscribe(str(endpoint), "models", timeout=500) as subscription,
    ):
        until(lambda: models.has_subscribers, models.serve_late_joiners)
        until(lambda: tracks._subscribed, tracks.serve_late_joiners)
        tracks.send(End(1, "the source has ended"))
        messages, ends = subscription._connection.messages, subscription._connection.ends

        def late(_, receive=ends.receive):  # the model arrives after the look for messages
            models.send(model(1))
            until(messages.pending)
            return receive(60)

        monkeypatch.setattr(ends, "receive", late)
        assert [message.version for message in subscription] == [1]
        assert subscription.end.reason == "the source has ended"


def test_iteration_continues_after_a_timeout(endpoint, tracks, until):
    with catstream.subscribe(str(endpoint), "tracks", timeout=0.1) as subscription:
        with pytest.raises(SilenceError, match="is a pipeline running there"):
            next(subscription)
        with pytest.raises(TimeoutError):
            next(subscription)
        subscription.timeout = 20
        until(lambda: len(tracks._subscribed) == 2, tracks.serve_late_joiners)  # the end has a connection of its own
        tracks.send(End(60, "the source has ended"))
        assert list(subscription) == []
        assert subscription.losses() == "60 missed, 60 of them before this subscriber connected"


def test_reason_of_a_silence_names_an_object_that_the_run_lacks(endpoint, turning, monkeypatch):
    with (
        Publisher(HEALTH, endpoint, "detector") as health,
        catstream.subscribe(str(endpoint), "tracks", object="ben", timeout=2) as subscription,
    ):
        ticks = chain([0.0], repeat(1.0))  # until there is a report
        monkeypatch.setattr(subscription, "_clock", lambda: 9.0 if subscription._connection.state else next(ticks))
        health.send(Health("detector", 1.0, {}, objects={"anna": {}}))
        with turning(health.serve_late_joiners), pytest.raises(SilenceError, match="running, without an object 'ben'"):
            next(subscription)


def test_async_for_yields_all_tracks_and_may_be_cancelled(tracks, attached):
    async def read(subscription):
        return [message.seq async for message in subscription]

    async def both():
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(anext(subscription), 0.05)
        subscription.timeout = 0.05
        with pytest.raises(SilenceError):
            await anext(subscription)
        subscription.timeout = 60
        reading = asyncio.create_task(read(subscription))
        for seq in range(2, 40):
            tracks.send(track(seq))
            await asyncio.sleep(0)
        tracks.send(End(41, "the source has ended"))
        return await reading

    with attached() as subscription:
        assert asyncio.run(both()) == list(range(2, 40))
        assert subscription.missed == 2


def test_subscriber_ends_if_the_sockets_are_gone(folder, until):
    with catstream.subscribe(str(folder), "tracks", timeout=500) as subscription:
        with reserve_endpoint(str(folder), folder) as place, Publisher(TRACKS, place) as publisher:
            until(lambda: publisher.has_subscribers, publisher.serve_late_joiners)
            publisher.send(track(1))
            assert next(subscription).seq == 1
        assert list(subscription) == []
        assert "did not receive its end" in subscription.end.reason


def test_behind_is_the_age_of_the_last_track(endpoint, tracks, attached, until):
    with Publisher(HEALTH, endpoint, "detector") as health, attached() as subscription:
        assert subscription.behind == 0, "there was no report"
        health.send(Health("detector", 1.0, {"time": 12.5}))
        tracks.send(replace(track(2), time=0.4))
        assert next(subscription).seq == 2
        until(lambda: subscription.behind, health.serve_late_joiners)
        assert subscription.behind == pytest.approx(12.1)
        tracks.send(replace(track(3), time=12.5))
        assert next(subscription).seq == 3
        assert subscription.behind == 0


def test_newest_subscription_ends_with_the_last_tracks(tracks, attached):
    with attached(newest=True) as subscription:
        for seq in range(2, 50):
            for name in ("anna", "ben"):
                tracks.send(track(seq, name))
        tracks.send(End(49, "the source has ended"))
        received = [(message.object, message.seq) for message in subscription]
    assert dict(received) == {"anna": 49, "ben": 49}
    assert len(received) < 2 * 48
    assert subscription.missed > 0
    assert subscription.end.reason == "the source has ended"

"""Published messages about several objects: each subscriber receives the newest message of each."""

import signal
import threading
from collections import deque

import numpy as np
import zmq
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from catstream.wire import newest
from catstream.wire.channels import MODELS, SAMPLES, TRACKS
from catstream.wire.codec import encode, opening, topic_of
from catstream.wire.discovery import private_folder
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Model, Sample, Summary, Track
from catstream.wire.newest import Publisher, Subscriber
from catstream.wire.rejects import rejected
from tests.wire.examples import model, track

NAMES = st.just("") | st.from_regex(r"\w[\w.-]{0,63}", fullmatch=True)


def joined(publisher, count, until):
    """Wait until subscribers have subscribed to so many topics."""
    until(lambda: len(publisher._subscribed) == count, publisher.serve_late_joiners)


@given(NAMES, NAMES)
@example("ann", "anna")
@example("", "anna")
@example("a" * 31, "a" * 32)
@example("é" * 20, "é" * 64)
def test_message_begins_with_the_topic_of_its_object_only(name, other):
    data = encode(track(1, name))
    assert data.startswith(opening(Track))
    assert data.startswith(opening(Track, name))
    assert topic_of(data) == ("track", name)
    assert data.startswith(opening(Track, other)) == (name == other)
    assert not data.startswith(opening(Model, name))


class Arrivals(RuleBasedStateMachine):
    """A subscriber to models at which messages arrive and are sometimes read; the socket is a queue in memory."""

    def __init__(self):
        super().__init__()
        self.folder = private_folder()
        self.subscriber = Subscriber(MODELS, Endpoint.parse(str(self.folder.__enter__())))
        self.socket, self.subscriber._socket = self.subscriber._socket, self
        self.queue, self.version, self.moment = deque(), 0, 0
        self.newest, self.received = {}, {}  # version of each object that arrived, and that was received last
        self.since = {}  # when the first message of each object arrived that was not received yet

    def get(self, _):
        return zmq.POLLIN if self.queue else 0

    def recv(self):
        return self.queue.popleft()

    def arrive(self, name):
        self.queue.append(encode(model(self.newest[name], name)))
        self.moment += 1
        self.since.setdefault(name, self.moment)

    @rule(name=st.sampled_from(["", "ann", "anna", "ben"]))
    def a_model_arrives(self, name):
        self.version += 1
        self.newest[name] = self.version
        self.arrive(name)

    @precondition(lambda self: self.newest)
    @rule(data=st.data())
    def a_model_is_repeated(self, data):
        self.arrive(data.draw(st.sampled_from(sorted(self.newest))))

    @rule()
    def one_is_read(self):
        """The newest message of the object that has waited longest is received, and no message twice."""
        expected = None
        for name in sorted(self.since, key=self.since.get):
            del self.since[name]
            if self.received.get(name) != self.newest[name]:
                expected = name, self.newest[name]
                break
        message = self.subscriber.receive(0)
        assert (None if message is None else (message.object, message.version)) == expected
        if expected is not None:
            self.received[expected[0]] = expected[1]

    @invariant()
    def at_most_one_message_of_each_object_is_stored(self):
        assert len(self.subscriber._arrived) <= len(self.newest)

    def teardown(self):
        self.subscriber._socket = self.socket
        self.subscriber.close()
        self.folder.__exit__(None, None, None)


TestArrivals = Arrivals.TestCase
TestArrivals.settings = settings(max_examples=60, stateful_step_count=40)


def newest_versions(publisher, subscriber, count, until):
    """The version of the last message of each object, once messages of so many objects were received."""
    versions = {}

    def turn():
        publisher.serve_late_joiners()
        versions.update({message.object: message.version for message in subscriber.receive_all()})

    until(lambda: len(versions) == count, turn)
    return versions


def test_late_joiner_receives_the_newest_model_of_each_object(endpoint, until):
    with Publisher(MODELS, endpoint) as models:
        for version, name in enumerate(["anna", "ben", "anna", "", "ben"], 1):
            models.send(model(version, name))
        with Subscriber(MODELS, endpoint) as late:
            assert newest_versions(models, late, 3, until) == {"anna": 3, "": 4, "ben": 5}
        with Subscriber(MODELS, endpoint, Model, about="anna") as late:
            assert newest_versions(models, late, 1, until) == {"anna": 3}
        models.keep_only(["anna", "carl"])
        models.send(model(6, "carl"))
        with Subscriber(MODELS, endpoint) as late:
            assert newest_versions(models, late, 2, until) == {"anna": 3, "carl": 6}


def test_late_joiner_after_the_end_receives_only_the_end(endpoint, until):
    end = End(1, "the source has ended")
    with Publisher(SAMPLES, endpoint) as samples:
        samples.send(sample(1, "anna"))
        samples.send(end)
        with Subscriber(SAMPLES, endpoint) as late:
            assert until(lambda: late.receive_all(0.01), samples.serve_late_joiners) == [end]


def sample(version, name, width=5):
    tree = Summary(np.ones((100, width), np.float32), np.ones(width, np.float32), 200, (0,))
    loss = Summary(np.ones((100, width + 2), np.float32), np.ones(width + 2, np.float32), 200, (0,))
    return Sample(version, 0, {"object": tree, "background": tree, "loss": loss}, np.empty((0, 2)), name)


def test_newest_of_each_object_arrives_after_a_large_burst(endpoint, until):
    objects = 3 * SAMPLES.high_water_mark
    with Publisher(SAMPLES, endpoint) as samples, Subscriber(SAMPLES, endpoint) as trainer:
        joined(samples, 1, until)
        for version in range(1, objects + 1):  # nothing is read meanwhile
            samples.send(sample(version, f"o{version}", width=500))
        received = newest_versions(samples, trainer, objects, until)
    assert received == {f"o{version}": version for version in range(1, objects + 1)}


class _InterruptError(Exception):
    pass


def test_interrupt_is_not_lost_while_messages_are_received(endpoint, until):
    """If one were lost, as in the destructor of a zmq.Frame, Python would warn that it ignores an exception."""
    raises, ended, interrupts = False, threading.Event(), 0

    def handle(*_):
        nonlocal raises
        if raises:
            raises = False
            raise _InterruptError

    def send(publisher):
        frame = 0
        while not ended.is_set():
            publisher.send(track(frame := frame + 1))
            if frame % 20 == 0:
                signal.raise_signal(signal.SIGUSR1)

    before = signal.signal(signal.SIGUSR1, handle)
    with Publisher(TRACKS, endpoint) as publisher, Subscriber(TRACKS, endpoint) as subscriber:
        joined(publisher, 1, until)
        sender = threading.Thread(target=send, args=[publisher])
        sender.start()
        try:
            while interrupts < 30:
                try:
                    raises = True
                    subscriber.receive(1.0)
                    raises = False  # outside this block, nothing catches it
                except _InterruptError:
                    interrupts += 1
        finally:
            raises = False
            ended.set()
            sender.join()
            signal.signal(signal.SIGUSR1, before)


def test_publisher_remembers_messages_of_at_most_256_names(endpoint, monkeypatch):
    monkeypatch.setattr(newest, "monotonic", lambda: 0.0)  # none is repeated meanwhile
    with Publisher(MODELS, endpoint) as models:
        for version in range(1, 600):
            models.send(model(version, f"o{version}"))
        assert list(models._last) == [("model", f"o{version}") for version in range(344, 600)]


def test_subscriber_remembers_at_most_1024_names():
    arrivals = Arrivals()
    try:
        arrivals.queue.extend(encode(model(version, f"o{version}")) for version in range(1, 1500))
        arrivals.queue.append(b"no message" * 100)
        versions = []
        while (message := arrivals.subscriber.receive(0)) is not None:
            versions.append(message.version)
            assert len(arrivals.subscriber._arrived) <= 256
            assert len(arrivals.subscriber._last) <= 1024
    finally:
        arrivals.teardown()
    assert versions == list(range(1, 1500))


def test_flood_of_subscriptions_is_counted_and_others_are_served(endpoint, until):
    before = rejected()
    with Publisher(TRACKS, endpoint) as tracks, Subscriber(TRACKS, endpoint) as honest:
        joined(tracks, 1, until)
        with zmq.Context.instance().socket(zmq.SUB) as stranger:
            stranger.linger = stranger.sndhwm = 0
            stranger.connect(endpoint.address(TRACKS))
            for number in range(1500):
                stranger.subscribe(opening(Track, f"o{number}"))
            until(lambda: rejected() >= before + 1500 - 1023, tracks.serve_late_joiners)
            assert len(tracks._subscribed) == 1024
            tracks.send(track(1, "anna"))
            assert honest.receive(30) == track(1, "anna")
        joined(tracks, 1, until)

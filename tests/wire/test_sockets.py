"""Channels between sockets: what arrives if one side dies or closes early, and the limits of the system."""

import resource
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zmq

import catstream
from catstream.errors import ServiceError
from catstream.wire.acknowledged import Receiver, Sender
from catstream.wire.channels import ALL_FEATURES, MODELS, RESULTS, SAMPLES, TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Position, Sample, Summary, Tracks
from catstream.wire.monitor import Event, Monitor
from catstream.wire.newest import Publisher, Subscriber
from catstream.wire.socket import context
from tests.wire.examples import model, track

WINDOW = 4


def tracks(seq):
    return Tracks(seq - 1, {"": track(seq)})


def test_message_above_the_limit_of_its_channel_is_an_error(endpoint):
    small = replace(RESULTS, megabytes=0)
    with Sender(small, endpoint, WINDOW) as sender, pytest.raises(ServiceError, match=r"lower coreset\.size"):
        sender.send(tracks(1))


def test_late_subscriber_receives_no_old_tracks(endpoint, until):
    with Publisher(TRACKS, endpoint) as publisher:
        publisher.send(track(1))
        with Subscriber(TRACKS, endpoint) as late:
            got, seq = [], iter(range(2, 10_000))
            until(lambda: got, lambda: (publisher.send(track(next(seq))), got.extend(late.receive_all())))
    assert got[0].seq > 1


def test_last_message_arrives_if_its_sender_closes_at_once(endpoint, until):
    tree, loss = (Summary(np.ones((200, d), np.float32), np.ones(d, np.float32), 200, (0,)) for d in (2000, 2002))
    large = Sample(1, 0, {"object": tree, "background": tree, "loss": loss}, np.empty((0, 2)))
    for _ in range(10):  # a race, as in the next test
        received = []
        with Subscriber(SAMPLES, endpoint) as reader, Publisher(SAMPLES, endpoint) as samples:
            samples.send(large)
            until(partial(reader.receive, 0.05), samples.serve_late_joiners)
            samples.send(large)
            samples.send(End(0, "it was the last"))
            samples.close()
            while not (received and isinstance(received[-1], End)):
                received += reader.receive_all(0.05)


def test_sender_learns_that_its_end_is_stored_if_receiver_closes(endpoint, until):
    for _ in range(10):
        with ThreadPoolExecutor(1) as pool, Sender(RESULTS, endpoint, WINDOW) as sender:
            receiver = Receiver(RESULTS, endpoint, Position(), WINDOW)
            sender.send(End(0, "it was the last"))
            until(partial(receiver.receive, 0.05), partial(sender.poll, 0))
            receiver.acknowledge(Position(1))
            pool.submit(receiver.close)
            while not sender.window.stored:
                sender.poll(0.02)


def test_ipv6_loopback_is_an_endpoint(until):
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6) as probe:
            port = probe.getsockname()[1]
    except OSError:
        pytest.skip("this machine has no IPv6")
    endpoint = Endpoint.parse(f"tcp://[::1]:{min(port, 65000)}")
    with Publisher(MODELS, endpoint) as models, Subscriber(MODELS, endpoint) as reader:
        until(lambda: reader.receive(0.01) is not None, lambda: models.send(model(1)))


def test_sockets_without_close_do_not_block_the_io_thread(endpoint):
    with Publisher(TRACKS, endpoint):
        dropped = [Subscriber(TRACKS, endpoint) for _ in range(10)]
        with pytest.warns(ResourceWarning, match="unclosed"):
            dropped.clear()
    other = context().socket(zmq.PUB)
    events = Monitor(other)
    other.close()
    assert Event.STOPPED in events.events(10_000)
    events.close()


@pytest.fixture
def open_files(until):
    """Sets the limit of open files of this process to as many more than it has now."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)

    def count():
        return len([*Path("/proc/self/fd").iterdir()])

    before = count()
    yield lambda more: resource.setrlimit(resource.RLIMIT_NOFILE, (before + more, hard))
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    until(lambda: count() <= before + 10)  # ZeroMQ closes its files some time later


def test_program_may_have_as_many_sockets_as_files(open_files):
    open_files(1200)
    with ExitStack() as stack:
        assert all(stack.enter_context(context().socket(zmq.PAIR)) for _ in range(1100))


def test_too_many_open_files_are_an_error_that_names_the_limit(folder, open_files):
    open_files(40)
    with ExitStack() as stack, pytest.raises(ServiceError, match="ulimit -n"):
        [stack.enter_context(catstream.subscribe(str(folder), "tracks")) for _ in range(40)]


SENDER = """
import sys
import numpy as np
from catstream.wire.messages import Features, ObjectFeatures, Position, TrainingRows
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import ALL_FEATURES
from catstream.wire.endpoint import Endpoint

rows = TrainingRows.labelled(np.ones((10, 100_000), np.float32), 1)
with Sender(ALL_FEATURES, Endpoint.parse(sys.argv[1]), 64) as features:
    features.ask_position(0)
    features.window.resume(0, Position())
    for seq in range(1, 33):
        features.send(Features(seq - 1, 0.0, {"anna": ObjectFeatures(None, {"appearance": rows})}))
"""


def test_process_with_queued_messages_ends_normally(folder):
    with zmq.Context.instance().socket(zmq.ROUTER) as receiver:
        receiver.set(zmq.LINGER, 0)
        receiver.set(zmq.RCVHWM, 1)
        receiver.bind(Endpoint.parse(str(folder)).listening(ALL_FEATURES))
        with subprocess.Popen([sys.executable, "-c", SENDER, str(folder)], stderr=subprocess.PIPE) as sender:
            while sender.poll() is None:
                if receiver.poll(20):
                    receiver.recv_multipart()
            assert sender.returncode == 0, sender.stderr.read().decode()

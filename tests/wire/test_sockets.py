"""Channels between sockets: what arrives when one side dies, dawdles, or is a stranger."""

import resource
import select
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zmq

import catstream
from catstream.errors import ServiceError
from catstream.messages.kinds import End, Model, Position, Sample, Summary, Track, Tracks
from catstream.wire.acknowledged import Receiver, Sender
from catstream.wire.channels import FEATURES, MODELS, RESULTS, SAMPLES, TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher, Subscriber
from catstream.wire.socket import Event, Monitor, context

WINDOW = 4


def track(seq, name=""):
    return Track(seq, seq - 1, 0.0, "absent", None, 0.0, 0, object=name)


def tracks(seq):
    return Tracks(seq, seq - 1, {"": track(seq)})


def model(version, name=""):
    return Model(version, version, np.full(5, version, np.float32), 0.0, object=name)


def send_up_to(last, sender):
    """One turn of a sender: the next message, up to the last one and if the window has room for it."""
    sender.poll(0)
    window = sender.window
    if window.sent < last and not window.full:
        sender.send(tracks(window.sent + 1))


def take(receiver, taken, *, store):
    """One turn of a receiver that stores what it takes, or only takes it."""
    message = receiver.receive(0.05)
    if message is not None:
        taken.append(message.seq)
        receiver.acknowledge(Position(message.seq if store else 0))
    receiver.answer()


def test_a_sender_does_not_need_its_receiver_to_be_there_first(endpoint, until):
    taken = []
    with Sender(RESULTS, endpoint, WINDOW) as sender:
        assert sender.ask_position(0) is None
        sender.send(tracks(1))
        with Receiver(RESULTS, endpoint, Position(), WINDOW) as receiver:

            def turn():
                sender.poll(0.05)
                take(receiver, taken, store=True)

            until(lambda: sender.window.stored == 1, turn)
    assert taken == [1]


def test_a_sender_that_asked_a_slow_receiver_still_learns_its_position(endpoint, until):
    taken = []
    with Receiver(RESULTS, endpoint, Position(), WINDOW) as receiver, Sender(RESULTS, endpoint, WINDOW) as sender:

        def turn():
            take(receiver, taken, store=False)
            sender.poll(0.05)

        sender.send(tracks(1))
        for _ in range(10):
            sender.poll(0.05)  # nobody answers: it asks where the receiver is, and will send all again
        for _ in range(10):
            turn()
        until(lambda: sender.window.taken == 1, turn)
    assert taken == [1]


def test_a_message_that_is_too_large_to_arrive_is_an_error_that_says_what_to_give(endpoint):
    small = replace(RESULTS, megabytes=0)
    with Sender(small, endpoint, WINDOW) as sender, pytest.raises(ServiceError, match=r"smaller coreset\.size"):
        sender.send(tracks(1))


def test_a_restarted_receiver_gets_all_that_was_not_stored(endpoint, until):
    taken = []
    with Sender(RESULTS, endpoint, 10) as sender:
        with Receiver(RESULTS, endpoint, Position(), 10) as receiver:
            for seq in range(1, 9):
                sender.send(tracks(seq))

            def turn():
                sender.poll(0)
                take(receiver, taken, store=len(taken) < 3)

            until(lambda: len(taken) == 6, turn)
            receiver.acknowledge(Position(3))
        again = []
        with Receiver(RESULTS, endpoint, Position(3, 3), 10) as receiver:

            def on():
                send_up_to(20, sender)
                take(receiver, again, store=True)

            until(lambda: sender.window.stored == 20, on)
    assert taken == [1, 2, 3, 4, 5, 6]
    assert again == list(range(4, 21))


def test_a_restarted_sender_repeats_no_received_message(endpoint, until):
    taken = []
    with Receiver(RESULTS, endpoint, Position(), 10) as receiver:
        with Sender(RESULTS, endpoint, 10) as sender:
            for seq in range(1, 6):
                sender.send(tracks(seq))

            def turn():
                sender.poll(0)
                take(receiver, taken, store=True)

            until(lambda: len(taken) == 5, turn)
        with Sender(RESULTS, endpoint, 10) as sender:
            found = []

            def ask():
                found.append(sender.ask_position(0))
                take(receiver, taken, store=True)

            until(lambda: found and found[-1] is not None, ask)
            assert found[-1].taken == 5
            sender.window.resume(3, found[-1])  # another receiver had less

            def on():
                send_up_to(9, sender)
                take(receiver, taken, store=True)

            until(lambda: sender.window.stored == 9, on)
    assert taken == list(range(1, 10))


#: Takes nothing while its queue is full and the sender dies, for longer than any timer of ZeroMQ.
BUSY_RECEIVER = """
import sys, time
from catstream.messages.kinds import Position
from catstream.wire.acknowledged import Receiver
from catstream.wire.channels import RESULTS
from catstream.wire.endpoint import Endpoint
with Receiver(RESULTS, Endpoint.parse(sys.argv[1]), Position(), 1) as receiver:
    print("ready", flush=True)
    receiver._socket.poll()
    print("arrived", flush=True)
    sys.stdin.readline()
    time.sleep(1.5)
    message = receiver.receive(60) or receiver.receive(60)  # a sender that had to wait asks for the position first
    print(message.seq)
"""


def test_a_receiver_with_a_full_queue_survives_its_sender(endpoint, until):
    command = [sys.executable, "-c", BUSY_RECEIVER, str(endpoint)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as busy:
        assert busy.stdout.readline() == "ready\n"
        with Sender(RESULTS, endpoint, 8) as sender:
            for seq in range(1, 9):
                sender.send(tracks(seq))
            until(lambda: select.select([busy.stdout], [], [], 0)[0], lambda: sender.poll(0.1))
        assert busy.communicate("gone\n", timeout=60)[0] == "arrived\n1\n"
    assert busy.returncode == 0


def test_a_reader_that_never_reads_blocks_nobody(endpoint, until):
    messages, long = 8000, "x" * 4000  # more than all buffers on the way hold
    with Publisher(TRACKS, endpoint) as publisher, Subscriber(TRACKS, endpoint) as idle:
        heard = []
        until(lambda: heard, lambda: (publisher.send(track(1)), heard.extend(idle.receive_all())))
        for seq in range(2, messages + 2):
            publisher.send(End(seq, long))
        rest = [message.seq for message in iter(lambda: idle.receive(0.2), None)]
    assert rest == sorted(set(rest)), "what arrives is in order"
    assert 0 < len(rest) < messages, "what does not fit is lost, and seq tells"


def test_a_late_subscriber_receives_no_old_tracks(endpoint, until):
    with Publisher(TRACKS, endpoint) as publisher:
        publisher.send(track(1))
        with Subscriber(TRACKS, endpoint) as late:
            got, seq = [], iter(range(2, 10_000))

            def turn():
                publisher.send(track(next(seq)))
                message = late.receive(0.01)
                if message is not None:
                    got.append(message.seq)

            until(lambda: got, turn)
    assert got[0] > 1


def test_the_last_message_arrives_even_if_its_sender_closes_at_once(endpoint, until):
    tree, loss = (Summary(np.ones((200, d), np.float32), np.ones(d, np.float32), 200, (0,)) for d in (2000, 2002))
    large = Sample(1, 0, {"object": tree, "background": tree, "loss": loss}, np.empty((0, 2)))

    def run():
        heard = []
        with Subscriber(SAMPLES, endpoint) as reader, Publisher(SAMPLES, endpoint) as samples:
            samples.send(large)
            until(lambda: reader.receive(0.05), samples.serve_late_joiners)
            samples.send(large)
            samples.send(End(1, "it was the last"))
            samples.close()
            until(lambda: heard and isinstance(heard[-1], End), lambda: heard.extend(reader.receive_all()))

    for _ in range(10):  # a race, as the next
        run()


def test_a_sender_learns_that_its_end_is_stored_though_the_receiver_closes_at_once(endpoint, until):
    def run():
        with ThreadPoolExecutor(1) as pool, Sender(RESULTS, endpoint, WINDOW) as sender:
            receiver = Receiver(RESULTS, endpoint, Position(), WINDOW)
            sender.send(End(1, "it was the last"))
            until(lambda: receiver.receive(0.05), lambda: sender.poll(0))
            receiver.acknowledge(Position(1))
            pool.submit(receiver.close)
            until(lambda: sender.window.stored == 1, lambda: sender.poll(0.02))

    for _ in range(10):  # a race, which was lost every other time
        run()


@pytest.mark.parametrize(
    "bind",
    [lambda endpoint: Receiver(FEATURES, endpoint, Position(), WINDOW), lambda endpoint: Publisher(MODELS, endpoint)],
    ids=["receiver", "publisher"],
)
def test_a_second_socket_at_the_same_address_is_rejected(endpoint, bind):
    with bind(endpoint):
        with pytest.raises(ServiceError, match="another pipeline may be running"):
            bind(endpoint)
        with pytest.raises(ServiceError, match="another pipeline may be running"):
            bind(endpoint)
    with bind(endpoint):
        pass


def test_ipv6_loopback_is_an_endpoint(until):
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6) as probe:
            port = probe.getsockname()[1]
    except OSError:
        pytest.skip("this machine has no IPv6")
    endpoint = Endpoint.parse(f"tcp://[::1]:{min(port, 65000)}")
    with Publisher(MODELS, endpoint) as models, Subscriber(MODELS, endpoint) as reader:
        until(lambda: reader.receive(0.01) is not None, lambda: models.send(model(1)))


def test_sockets_that_are_dropped_without_close_do_not_block_the_thread_on_which_all_others_depend(endpoint):
    with Publisher(TRACKS, endpoint):
        dropped = [Subscriber(TRACKS, endpoint) for _ in range(10)]
        with pytest.warns(ResourceWarning, match="not closed"):
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


def test_a_program_may_have_as_many_sockets_as_files(open_files):
    open_files(1200)
    with ExitStack() as stack:
        assert all(stack.enter_context(context().socket(zmq.PAIR)) for _ in range(1100))


def test_too_many_open_files_are_an_error_that_names_the_limit(folder, open_files):
    open_files(40)
    with ExitStack() as stack, pytest.raises(ServiceError, match="ulimit -n"):
        [stack.enter_context(catstream.subscribe(str(folder), "tracks")) for _ in range(40)]

"""Messages from strangers on any channel are counted by their cause and dropped."""

import socket
from contextlib import closing

import msgpack
import numpy as np
import pytest
import zmq

from catstream.base.settings import Settings
from catstream.coreset.forest import Forest
from catstream.wire.acknowledged import Receiver, Sender
from catstream.wire.channels import ALL_FEATURES, CHANNELS, RESULTS
from catstream.wire.codec import VERSION, encode
from catstream.wire.messages import End, Features, Health, ObjectFeatures, Position, TrainingRows
from catstream.wire.monitor import Event, Monitor
from catstream.wire.newest import Publisher, Subscriber
from catstream.wire.rejects import rejected
from tests.wire.examples import example, track

WINDOW = 4
PUBLISHED = [name for name, channel in CHANNELS.items() if channel.receiver is None]


def features(seq, width=5):
    training = {"appearance": TrainingRows.labelled(np.ones((3, width)), 1)}
    return Features(seq - 1, 0.0, {"anna": ObjectFeatures(None, training)})


#: Invalid messages of features by their cause; test_codec.py has all violations of the schema.
WRONG = {
    "msgpack": [b"GET / HTTP/1.1"],
    "envelope": [msgpack.packb({"frame": 1})],
    "version": [msgpack.packb([VERSION - 1, "features", "", "", {}])],
    "kind": [encode(Health("trainer", 0.0))],
    "width": [encode(features(2, width=6))],
    "sequence": [encode(features(2**40))],
    "parts": [b"", encode(features(2)), *[b"x"] * 20_000],
}


@pytest.mark.parametrize("wrong", WRONG)
def test_invalid_message_is_counted_and_affects_no_sender(wrong, endpoint, stranger, until):
    forest, before, received = Forest(Settings(coreset={"size": 2})), rejected(), []
    with (
        Receiver(ALL_FEATURES, endpoint, Position(), WINDOW, check=forest.check_features) as receiver,
        Sender(ALL_FEATURES, endpoint, WINDOW) as sender,
    ):

        def turn():
            if sender.window.sent <= len(received):
                sender.send(features(sender.window.sent + 1))
            sender.poll(0.01)
            if (message := receiver.receive(0.01)) is not None:
                received.append(message.seq)
                forest.take(message)
                receiver.acknowledge(Position(message.seq))

        until(lambda: sender.window.stored >= 1, turn)
        stranger(zmq.DEALER, "all-features").send_multipart(WRONG[wrong])
        until(lambda: rejected() == before + 1, turn)
        until(lambda: sender.window.stored > 5, turn)
    assert received == list(range(1, len(received) + 1)), "each once, in order"
    assert forest.seq == received[-1]


def test_replies_to_a_stranger_do_not_redirect_acknowledgements(endpoint, stranger, until):
    received = []
    with Receiver(RESULTS, endpoint, Position(), WINDOW) as receiver, Sender(RESULTS, endpoint, WINDOW) as sender:
        other = stranger(zmq.DEALER, "results")

        def turn():
            if (message := receiver.receive(0.01)) is not None:
                received.append(message.seq)
            sender.poll(0)

        sender.send(End(0, "the source has ended"))
        until(lambda: received == [1], turn)
        for question in (b"", encode(End(0, "replayed"))):
            other.send(question)
            until(lambda: other.poll(0), turn)
            other.recv()
        receiver.acknowledge(Position(1))  # stored only now
        until(lambda: sender.window.stored == 1, lambda: sender.poll(0.01))
        assert not other.poll(50)


@pytest.mark.parametrize("name", PUBLISHED)
def test_message_to_a_publisher_affects_no_subscriber(name, endpoint, stranger, until):
    message, before, received = example(CHANNELS[name].messages[0]), rejected(), []
    channel = CHANNELS[name]
    with Publisher(channel, endpoint, channel.senders[0]) as publisher, Subscriber(channel, endpoint) as reader:
        other = stranger(zmq.XSUB, name)
        for junk in (b"GET / HTTP/1.1", b"\x01topic", encode(End(8, "forged"))):
            other.send(junk)
        other.send(b"\x01" + bytes(10_000))  # above the limit: ZeroMQ ends the connection
        until(
            lambda: rejected() >= before + 3 and received,
            lambda: (publisher.send(message), received.extend(reader.receive_all())),
        )
    assert {type(each) for each in received} == {type(message)}


@pytest.mark.parametrize("sent", [b"", b"\xff" + bytes(8) + b"\x7f"], ids=["nothing", "a part of the greeting"])
def test_client_that_leaves_during_its_handshake_is_not_counted(sent, endpoint, until):
    before = rejected()
    address = endpoint.address(CHANNELS["tracks"]).partition("://")[2]
    if endpoint.folder is None:
        host, _, port = address.partition(":")
        address = host, int(port)
    with Publisher(CHANNELS["tracks"], endpoint) as publisher:
        for _ in range(20):
            with socket.socket(socket.AF_UNIX if endpoint.folder else socket.AF_INET) as leaving:
                leaving.connect(address)
                leaving.sendall(sent)
        with Subscriber(CHANNELS["tracks"], endpoint) as reader:
            until(lambda: reader.receive(0.01), lambda: publisher.send(track(1)))
        assert rejected() == before


def test_message_above_the_limit_closes_its_connection(endpoint, stranger, until):
    before = rejected()
    with Receiver(RESULTS, endpoint, Position(), WINDOW) as receiver, Sender(RESULTS, endpoint, WINDOW) as sender:
        other = stranger(zmq.DEALER, "results")
        with closing(Monitor(other)) as events:
            other.send(bytes(CHANNELS["results"].limit + 1))
            until(lambda: Event.DISCONNECTED in events.events(0.05), lambda: receiver.receive(0))
            other.disable_monitor()
        sender.send(End(0, "the source has ended"))
        assert until(lambda: receiver.receive(0.05), lambda: sender.poll(0)).seq == 1
    assert rejected() == before

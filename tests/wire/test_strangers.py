"""What a stranger sends on any channel is counted by what is wrong with it, and dropped: nothing is trusted."""

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

WINDOW = 4
PUBLISHED = [name for name, channel in CHANNELS.items() if channel.receiver is None]


def features(seq, width=5):
    training = {"appearance": TrainingRows.labelled(np.ones((3, width)), 1)}
    return Features(seq - 1, 0.0, {"anna": ObjectFeatures(None, training)})


#: What may be wrong with a message of features: test_codec.py has all that its schema does not allow.
WRONG = {
    "msgpack": [b"GET / HTTP/1.1"],
    "envelope": [msgpack.packb({"frame": 1})],
    "version": [msgpack.packb([VERSION - 1, "features", "", "", {}])],
    "kind": [encode(Health("trainer", 0.0))],
    "width": [encode(features(2, width=6))],
    "sequence": [encode(features(2**40))],
    "parts": [b"", encode(features(2)), *[b"x"] * 20_000],
}


@pytest.mark.parametrize("what", WRONG)
def test_an_invalid_message_is_counted_and_does_not_affect_the_legitimate_sender(what, endpoint, stranger, until):
    forest, before, taken = Forest(Settings(coreset={"size": 2})), rejected(), []
    with (
        Receiver(ALL_FEATURES, endpoint, Position(), WINDOW, check=forest.check_features) as receiver,
        Sender(ALL_FEATURES, endpoint, WINDOW) as sender,
    ):

        def turn():
            sender.send(features(sender.window.sent + 1)) if sender.window.sent < len(taken) + 1 else sender.poll(0.01)
            if (message := receiver.receive(0.01)) is not None:
                taken.append(message.seq)
                forest.take(message)
                receiver.acknowledge(Position(message.seq))

        until(lambda: sender.window.stored >= 1, turn)
        stranger(zmq.DEALER, "all-features").send_multipart(WRONG[what])
        until(lambda: rejected() == before + 1, turn)
        until(lambda: sender.window.stored > 5, turn)
    assert taken == list(range(1, len(taken) + 1)), "each once, in order"
    assert forest.seq == taken[-1]


def test_acknowledgements_are_sent_only_to_the_sender_of_the_accepted_message(endpoint, stranger, until):
    taken = []
    with Receiver(RESULTS, endpoint, Position(), WINDOW) as receiver, Sender(RESULTS, endpoint, WINDOW) as sender:
        other = stranger(zmq.DEALER, "results")

        def turn():
            if (message := receiver.receive(0.01)) is not None:
                taken.append(message.seq)
            sender.poll(0)

        sender.send(End(0, "the source has ended"))
        until(lambda: taken == [1], turn)
        other.send(b"")
        until(lambda: other.poll(0), turn)
        other.recv()
        other.send(encode(End(0, "replayed")))
        until(lambda: other.poll(0), turn)
        other.recv()
        receiver.acknowledge(Position(1))  # stored only now
        until(lambda: sender.window.stored == 1, lambda: sender.poll(0.01))
        assert not other.poll(50)


@pytest.mark.parametrize("name", PUBLISHED)
def test_messages_to_a_publisher_are_counted_and_do_not_affect_its_subscribers(
    name, endpoint, stranger, message_of, until
):
    said = message_of(name)
    before, heard = rejected(), []
    with (
        Publisher(CHANNELS[name], endpoint, CHANNELS[name].senders[0]) as publisher,
        Subscriber(CHANNELS[name], endpoint) as reader,
    ):
        other = stranger(zmq.XSUB, name)
        for junk in (b"GET / HTTP/1.1", b"\x01topic", encode(End(8, "forged"))):
            other.send(junk)
        other.send(b"\x01" + bytes(10_000))  # above the limit: ZeroMQ ends the connection
        until(
            lambda: rejected() >= before + 3 and heard,
            lambda: (publisher.send(said), heard.extend(reader.receive_all())),
        )
    assert {type(message) for message in heard} == {type(said)}


@pytest.mark.parametrize("sent", [b"", b"\xff" + bytes(8) + b"\x7f"], ids=["nothing", "a part of the greeting"])
def test_a_client_that_leaves_during_its_handshake_is_not_counted(sent, endpoint, message_of, until):
    before, heard = rejected(), []
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
            until(lambda: heard, lambda: (publisher.send(message_of("tracks")), heard.extend(reader.receive_all(0.01))))
        assert rejected() == before


def test_a_message_above_the_size_limit_closes_its_connection_unread(endpoint, stranger, until):
    before, taken = rejected(), []
    with Receiver(RESULTS, endpoint, Position(), WINDOW) as receiver, Sender(RESULTS, endpoint, WINDOW) as sender:
        other = stranger(zmq.DEALER, "results")
        with closing(Monitor(other)) as events:
            other.send(bytes(CHANNELS["results"].limit + 1))
            until(lambda: Event.DISCONNECTED in events.events(0.05), lambda: receiver.receive(0))
            other.disable_monitor()
        sender.send(End(0, "the source has ended"))

        def turn():
            sender.poll(0)
            if (message := receiver.receive(0.05)) is not None:
                taken.append(message.seq)

        until(lambda: taken, turn)
    assert (taken, rejected()) == ([1], before)

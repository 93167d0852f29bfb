"""Authentication with keys, with real sockets on every channel."""

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace

import pytest
import zmq

import catstream
from catstream.client.address import Address
from catstream.errors import ServiceError
from catstream.wire.acknowledged import Receiver, Sender
from catstream.wire.channels import ALL_FEATURES, CHANNELS, CONTROL, TRACKS
from catstream.wire.codec import encode
from catstream.wire.commands import Requester, Responder
from catstream.wire.endpoint import Endpoint
from catstream.wire.keys import Keys, allow, clients, create
from catstream.wire.messages import Answer, Command, End, Features, Position
from catstream.wire.newest import Publisher, Subscriber
from catstream.wire.rejects import rejected
from tests.wire.examples import track

WINDOW = 4
CLIENTS = {"watcher": "watch", "operator": "control", "host": "pipeline"}  # name and role

#: The clients that may not connect to a channel of each role.
OUTSIDE = [
    *((name, who) for name in ("tracks", "control", "all-features") for who in ("none", "wrong")),
    ("control", "watcher"),
    ("all-features", "watcher"),
    ("all-features", "operator"),
]


@pytest.fixture
def keys(folder):
    """The folder of a pipeline's keys; next to it those of a client of each role, and of another pipeline."""
    create(folder / "keys")
    create(folder / "wrong")
    for name, role in CLIENTS.items():
        allow(folder / "keys", name, role, output=folder / name)
    return folder / "keys"


@pytest.fixture
def place(keys, tcp):
    """The endpoint with a folder of keys: the pipeline's, a client's, another pipeline's or none."""
    return lambda who="keys": Endpoint.parse(tcp, "" if who == "none" else str(keys.parent / who))


@pytest.fixture
def listener(place):
    """Opens the listening side of a channel; returns a function that receives or sends a message."""
    with ExitStack() as stack:

        def listen(name):
            if name == "all-features":
                receiver = stack.enter_context(Receiver(ALL_FEATURES, place(), Position(), WINDOW))
                return lambda: receiver.receive(0.02)
            if name == "control":
                responder = stack.enter_context(Responder(CONTROL, place()))
                return lambda: responder.receive_all() or None
            publisher = stack.enter_context(Publisher(TRACKS, place()))
            return lambda: publisher.send(track(1))

        yield listen


@pytest.fixture
def stranger():
    """Opens a raw socket that sends a message of a channel, or subscribes to all."""
    with ExitStack() as stack:

        def connect(name, endpoint):
            socket = stack.enter_context(zmq.Context.instance().socket(zmq.SUB if name == "tracks" else zmq.DEALER))
            socket.linger = 0
            if endpoint.keys is not None:
                socket.curve_serverkey = endpoint.keys.server
                socket.curve_publickey, socket.curve_secretkey = endpoint.keys.public, endpoint.keys.secret
            socket.connect(endpoint.address(CHANNELS[name]))
            if name == "tracks":
                socket.subscribe(b"")
            else:
                with suppress(zmq.Again):  # it may be rejected already
                    socket.send(encode(Command("1", "stop") if name == "control" else End(0, "forged")), zmq.NOBLOCK)
            return socket

        yield connect


def test_key_files_and_folders_are_private_with_any_umask(folder):
    before = os.umask(0)
    try:
        create(folder / "keys")
        allow(folder / "keys", "phone", "watch", output=folder / "phone")
    finally:
        os.umask(before)
    made = {stat.S_IMODE(path.stat().st_mode) for path in folder.glob("*/**/*") if path.is_file()}
    assert made == {0o600}
    assert {stat.S_IMODE(path.stat().st_mode) for path in folder.glob("**/") if path != folder} == {0o700}


def test_keys_are_not_overwritten_and_names_are_no_paths(keys):
    before = {path: path.read_bytes() for path in keys.parent.glob("**/*") if path.is_file()}
    with pytest.raises(ServiceError, match="contains keys already"):
        create(keys)
    for name, output, error in [
        ("other", "watcher", "not overwritten"),
        ("operator", "new", "a client operator exists"),
        *((name, "new", "a client name") for name in ("", ".", "../keys", "a/b", ".hidden", "a b", "x" * 65)),
    ]:
        with pytest.raises(ServiceError, match=error):
            allow(keys, name, "control", output=keys.parent / output)
    assert before == {path: path.read_bytes() for path in keys.parent.glob("**/*") if path.is_file()}
    assert set(clients(keys)) == {*CLIENTS, "pipeline"}


def test_keys_that_are_readable_or_of_a_client_are_rejected(keys, place):
    with pytest.raises(ServiceError, match="made by `catstream keys new`"):
        Publisher(TRACKS, place("watcher"))
    known = Keys.load(keys)
    assert known.secret.decode() not in repr(known)
    (keys / "client.key").chmod(0o640)
    with pytest.raises(ServiceError, match="chmod 600"):
        Keys.load(keys)


@pytest.mark.parametrize("text", [b"", b"public = 'short'", b"public = 1", b"\xff\x00", b"public = " + b"[" * 4000])
def test_damaged_key_file_is_an_error_that_names_it(keys, text):
    (keys / "client.key").write_bytes(text)
    with pytest.raises(ServiceError, match=r"client\.key .*make new keys"):
        Keys.load(keys)


@pytest.mark.parametrize(("name", "who"), OUTSIDE)
def test_client_without_permission_receives_nothing(name, who, place, listener, stranger, until, caplog):
    reason = who if who in CLIENTS else ""
    turn, received, before = listener(name), [], rejected()
    one, two = stranger(name, place(who)), stranger(name, place("none" if who == "wrong" else who))
    until(lambda: rejected() >= before + 2, lambda: received.append(turn()))
    assert not any(received)
    assert not one.poll(50)
    assert not two.poll(0)
    logged = [record.message for record in caplog.records if "rejected" in record.message]
    assert len(logged) <= 1, "once for all, where it was not logged before"
    assert not reason or reason in logged[0]


def test_clients_exchange_messages_according_to_their_roles(place, until):
    features, answers, tracks = [], [], []
    with (
        Receiver(ALL_FEATURES, place(), Position(), WINDOW) as receiver,
        Sender(ALL_FEATURES, place(), WINDOW) as sender,
        Responder(CONTROL, place()) as detector,
        Requester(CONTROL, place("operator")) as operator,
        Publisher(TRACKS, place()) as publisher,
        Subscriber(TRACKS, place("watcher")) as watcher,
    ):

        def turn():
            sender.poll(0)
            publisher.send(track(1))
            features.append(receiver.receive(0.02))
            tracks.append(watcher.receive(0.02))
            for command in detector.receive_all():
                detector.answer(Answer(command.id, True, "", 1))
            answers.append(operator.ask(Command("1", "pause"), 0.05))

        sender.send(Features(0, 0.0, {}))
        until(lambda: any(features) and any(answers) and any(tracks), turn)


@pytest.mark.parametrize(
    ("server", "client", "cause"),
    [
        ("keys", "watcher", "lacks the role control, which control requires"),
        ("none", "keys", "has no keys: connect without keys"),
        ("keys", "none", r"requires authentication.*--keys DIR"),
        ("keys", "wrong", "is a pipeline running there, with the keys in .*wrong"),
    ],
)
def test_client_that_cannot_connect_gets_an_error_with_the_cause(place, until, server, client, cause):
    at = place(client)
    address = Address(str(at), keys=str(at.keys.folder) if at.keys is not None else "")
    with (
        Responder(CONTROL, place(server)) as detector,
        ThreadPoolExecutor(1) as pool,
        catstream.control(address, timeout=1.0 if client == "wrong" else 60.0) as control,
    ):
        stopping = pool.submit(control.stop)
        until(stopping.done, lambda: detector.receive_all(0.02))
        with pytest.raises(ServiceError, match=cause):
            stopping.result()


def test_client_is_allowed_and_revoked_without_a_restart(keys, place, until):
    damaged, before = keys / "clients" / "operator", rejected()
    good = damaged.read_bytes()
    with Publisher(TRACKS, place()) as tracks:
        allow(keys, "late", "watch", output=keys.parent / "late")
        damaged.write_bytes(b"role = ")
        with Subscriber(TRACKS, place("late")) as reader:
            until(lambda: rejected() > before, lambda: tracks.send(track(1)))
            assert not reader.receive_all()
            damaged.write_bytes(good)
            until(lambda: reader.receive_all(0.02), lambda: tracks.send(track(1)))
        (keys / "clients" / "late").unlink()
        with Subscriber(TRACKS, place("late")) as reader, pytest.raises(ServiceError, match="rejects the key"):
            until(lambda: False, lambda: (tracks.send(track(2)), reader.receive(0.02)))


def test_key_of_one_pipeline_is_not_valid_for_another(place, keys, folder, until):
    (folder / "sockets").mkdir(mode=0o700)
    other = Endpoint.parse(str(folder / "sockets"), str(folder / "wrong"))
    known = replace(Keys.load(keys), server=other.keys.server)
    with (
        Publisher(TRACKS, place()),
        Publisher(TRACKS, other) as tracks,
        Subscriber(TRACKS, replace(other, keys=known)) as stranger,
        pytest.raises(ServiceError, match="rejects the key"),
    ):
        until(lambda: False, lambda: (tracks.send(track(1)), stranger.receive(0.02)))

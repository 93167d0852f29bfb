"""Who comes in, where a pipeline has keys: with real sockets, on every channel."""

import os
import socket
import stat
from contextlib import ExitStack, suppress

import pytest
import zmq

import catstream
from catstream.errors import ServiceError, SilenceError
from catstream.messages.kinds import Answer, Command, End, Features, Position
from catstream.wire.acknowledged import Receiver, Sender
from catstream.wire.channels import ALL_FEATURES, CHANNELS, CONTROL, MODELS, TRACKS
from catstream.wire.codec import encode
from catstream.wire.commands import Requester, Responder
from catstream.wire.endpoint import Endpoint
from catstream.wire.keys import ROLES, Keys, allow, clients, create, revoke
from catstream.wire.newest import Publisher, Subscriber
from catstream.wire.results import ResultsReceiver, ResultsSender
from tests.wire.examples import rejected, track

WINDOW = 4
CLIENTS = {"watcher": "watch", "operator": "control", "host": "pipeline"}  # name and role of some
WATCHED = [name for name, channel in CHANNELS.items() if channel.role == "watch"]

#: Of each channel, who has no place there.
OUTSIDE = [(name, who) for name in CHANNELS for who in ("none", "wrong", "revoked")] + [
    (name, who)
    for name, channel in CHANNELS.items()
    for who, role in CLIENTS.items()
    if ROLES.index(role) < ROLES.index(channel.role)
]


@pytest.fixture
def keys(folder):
    """The folder of a pipeline's keys; beside it those of a client of each role."""
    create(folder / "keys")
    for name, role in CLIENTS.items():
        allow(folder / "keys", name, role, output=folder / name)
    return folder / "keys"


@pytest.fixture
def place(keys, tcp):
    """The endpoint as who holds a folder of keys sees it: the pipeline's, a client's, another pipeline's or none."""

    def seen_with(who="keys"):
        if who == "wrong":
            create(keys.parent / "wrong")
        return Endpoint.parse(tcp, "" if who == "none" else str(keys.parent / who))

    return seen_with


@pytest.fixture
def listener(place, message_of):
    """The listening side of a channel, and one turn of it: what it took."""
    with ExitStack() as stack:

        def listen(name):
            if name == "all-features":
                receiver = stack.enter_context(Receiver(ALL_FEATURES, place(), Position(), WINDOW))
                return lambda: receiver.receive(0.02)
            if name == "results":
                owner = stack.enter_context(ResultsReceiver(place(), WINDOW, 0))
                return lambda: owner.receive(0.02)
            if name == "control":
                responder = stack.enter_context(Responder(CONTROL, place()))
                return lambda: responder.receive_all() or None
            publisher = stack.enter_context(Publisher(CHANNELS[name], place(), CHANNELS[name].senders[0]))
            return lambda: publisher.send(message_of(name))

        yield listen


@pytest.fixture
def stranger():
    """A raw socket that says on a channel what is said there, and hears all."""
    with ExitStack() as stack:

        def connect(name, endpoint):
            kind = {"all-features": zmq.DEALER, "control": zmq.DEALER, "results": zmq.PUSH}.get(name, zmq.SUB)
            socket = stack.enter_context(zmq.Context.instance().socket(kind))
            socket.linger = 0
            if endpoint.keys is not None:
                socket.curve_serverkey = endpoint.keys.server
                socket.curve_publickey, socket.curve_secretkey = endpoint.keys.public, endpoint.keys.secret
            if kind == zmq.SUB:
                socket.subscribe(b"")
            socket.connect(endpoint.address(CHANNELS[name]))
            if kind != zmq.SUB:
                said = Command("1", "stop") if name == "control" else End(0, "forged")
                with suppress(zmq.Again):  # it may be rejected already
                    socket.send(encode(said), zmq.NOBLOCK)
            return socket

        yield connect


def test_key_files_are_private_from_their_first_byte(folder, monkeypatch):
    modes, fsync = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: (modes.append(os.fstat(handle).st_mode), fsync(handle)))
    before = os.umask(0)
    try:
        create(folder / "keys")
        allow(folder / "keys", "phone", "watch", output=folder / "phone")
    finally:
        os.umask(before)
    files = [path for path in folder.glob("*/**/*") if path.is_file()]
    modes = [mode for mode in modes if stat.S_ISREG(mode)]  # the folders are written to disk, too
    assert len(files) == len(modes) == 7
    assert {stat.S_IMODE(mode) for mode in [*modes, *(path.stat().st_mode for path in files)]} == {0o600}
    assert {stat.S_IMODE(path.stat().st_mode) for path in folder.glob("**/") if path != folder} == {0o700}


def test_keys_are_not_written_over(keys):
    before = {path: path.read_bytes() for path in keys.parent.glob("**/*") if path.is_file()}
    with pytest.raises(ServiceError, match="holds keys already"):
        create(keys)
    with pytest.raises(ServiceError, match="not overwritten"):
        allow(keys, "other", "watch", output=keys.parent / "watcher")
    with pytest.raises(ServiceError, match="a client operator already"):
        allow(keys, "operator", "control", output=keys.parent / "other")
    assert before == {path: path.read_bytes() for path in keys.parent.glob("**/*") if path.is_file()}


def test_a_client_with_keys_of_its_own_is_allowed_by_the_public_one(keys):
    public, _ = zmq.curve_keypair()
    allow(keys, "desk", "control", public=public.decode())
    assert Keys.load(keys).client(public.decode()) == ("desk", "control")
    with pytest.raises(ServiceError, match="that of desk"):
        allow(keys, "again", "watch", public=public.decode())


@pytest.mark.parametrize("name", ["", ".", "../keys", "a/b", ".hidden", "a b", "x" * 65])
def test_a_client_has_a_name_that_is_no_path(keys, name):
    with pytest.raises(ServiceError, match="a client's name"):
        allow(keys, name, "watch", output=keys.parent / "new")
    assert set(clients(keys)) == {*CLIENTS, "pipeline"}


def test_a_secret_key_that_other_users_can_read_is_rejected(keys):
    known = Keys.load(keys)
    assert known.secret.decode() not in repr(known)
    (keys / "client.key").chmod(0o640)
    with pytest.raises(ServiceError, match="chmod 600"):
        Keys.load(keys)


@pytest.mark.parametrize("text", [b"", b"public = 'short'", b"public = 1", b"\xff\x00", b"public = " + b"[" * 4000])
def test_a_damaged_file_is_named(keys, text):
    (keys / "client.key").write_bytes(text)
    with pytest.raises(ServiceError, match="make new keys"):
        Keys.load(keys)


def test_a_client_cannot_impersonate_the_pipeline(place):
    with pytest.raises(ServiceError, match="keys of a client"):
        Publisher(TRACKS, place("watcher"))


@pytest.mark.parametrize("name", WATCHED)
def test_a_client_that_may_watch_receives_messages(name, place, listener, until):
    turn, heard = listener(name), []
    with Subscriber(CHANNELS[name], place("watcher")) as reader:
        until(lambda: heard, lambda: (turn(), heard.extend(reader.receive_all())))
    assert heard


def test_a_client_that_may_send_commands_receives_answers(place, until):
    with Responder(CONTROL, place()) as detector, Requester(CONTROL, place("operator")) as operator:
        answers = []

        def turn():
            for command in detector.receive_all():
                detector.answer(Answer(command.id, True, "", 1))
            answers.append(operator.ask(Command("1", "pause"), 0.2))

        turn()
        until(lambda: answers[-1] is not None, turn)


def test_an_acknowledged_channel_works_with_the_keys_of_the_pipeline(place, until):
    taken = []
    with (
        Receiver(ALL_FEATURES, place(), Position(), WINDOW) as receiver,
        Sender(ALL_FEATURES, place(), WINDOW) as sender,
    ):

        def turn():
            sender.poll(0)
            if (seq := sender.window.sent + 1) <= 50 and not sender.window.full:
                sender.send(Features(seq - 1, 0.0, {}))
            if (message := receiver.receive(0.02)) is not None:
                taken.append(message.seq)
                receiver.acknowledge(Position(message.seq, message.seq))

        until(lambda: sender.window.stored == 50, turn)
    assert taken == list(range(1, 51))


@pytest.mark.parametrize(("name", "who"), OUTSIDE)
def test_a_client_without_permission_receives_nothing_and_is_counted_and_logged_once(
    name, who, keys, place, listener, stranger, until, caplog
):
    reason = "role" if who in CLIENTS else "handshake"
    if who == "revoked":
        who, reason = "host", "key"
        revoke(keys, who)
    turn, taken, before = listener(name), [], rejected()
    one, two = stranger(name, place(who)), stranger(name, place("none" if who == "wrong" else who))
    until(lambda: rejected() >= before + 2, lambda: taken.append(turn()))
    assert not any(taken)
    assert not one.poll(50)
    assert not two.poll(0)
    told = [record.message for record in caplog.records if "rejected" in record.message]
    assert len(told) <= 1, "once for all, where it was not told before"
    if reason != "handshake":
        assert who in told[0] if reason == "role" else Keys.load(keys.parent / who).public.decode() in told[0]


@pytest.mark.parametrize("name", ["all-features", "results", "control"])
def test_a_client_that_may_only_watch_gets_an_error_if_it_sends(name, place, listener, until):
    turn, watcher = listener(name), place("watcher")
    clients = {
        "all-features": lambda: Sender(ALL_FEATURES, watcher, WINDOW),
        "results": lambda: ResultsSender(watcher),
        "control": lambda: Requester(CONTROL, watcher),
    }
    with (
        clients[name]() as client,
        pytest.raises(ServiceError, match=f"rejects this key: it was revoked, .* which {name} requires"),
    ):
        until(lambda: False, lambda: (turn(), client._wait(0.02)))


def test_a_client_is_revoked_even_if_its_file_is_damaged_but_never_the_pipeline(keys):
    with pytest.raises(ServiceError, match="make keys in another folder"):
        revoke(keys, "pipeline")
    (keys / "clients" / "operator").write_bytes(b"\xff")
    (keys / "clients" / "host").write_bytes(b"")
    revoke(keys, "operator")
    revoke(keys, "host")
    assert set(clients(keys)) == {"pipeline", "watcher"}
    (keys / "clients" / "other").mkdir()
    with pytest.raises(ServiceError, match="cannot write"):
        revoke(keys, "other")


def test_a_revoked_client_receives_until_its_connection_ends_and_cannot_reconnect(keys, place, until):
    heard = []
    with Subscriber(TRACKS, place("watcher")) as reader:
        with Publisher(TRACKS, place()) as tracks:
            until(lambda: heard, lambda: (tracks.send(track(1)), heard.extend(reader.receive_all())))
            revoke(keys, "watcher")
            until(lambda: heard[-1].seq == 2, lambda: (tracks.send(track(2)), heard.extend(reader.receive_all())))
            with Subscriber(TRACKS, place("watcher")) as another, pytest.raises(ServiceError, match="rejects this key"):
                until(lambda: False, lambda: (tracks.send(track(3)), another.receive(0.02)))
        list(iter(lambda: reader.receive(0.05), None))  # what was on its way
        with Publisher(TRACKS, place()) as tracks, pytest.raises(ServiceError, match="rejects this key"):
            until(lambda: False, lambda: (tracks.send(track(4)), heard.append(reader.receive(0.02))))
    assert {message.seq for message in heard if message} <= {1, 2, 3}


def test_a_client_that_is_allowed_later_needs_no_restart(keys, place, until):
    heard = []
    with Publisher(TRACKS, place()) as tracks:
        tracks.send(track(1))
        allow(keys, "late", "watch", output=keys.parent / "late")
        with Subscriber(TRACKS, place("late")) as reader:
            until(lambda: heard, lambda: (tracks.send(track(2)), heard.extend(reader.receive_all())))


def test_clients_are_rejected_as_long_as_their_keys_cannot_be_read(keys, place, until):
    heard, before = [], rejected()
    good = (keys / "clients" / "operator").read_bytes()
    (keys / "clients" / "operator").write_bytes(b"role = ")
    with Publisher(TRACKS, place()) as tracks, Subscriber(TRACKS, place("watcher")) as reader:

        def turn():
            tracks.send(track(1))
            heard.extend(reader.receive_all())

        until(lambda: rejected() > before, turn)
        assert not heard
        (keys / "clients" / "operator").write_bytes(good)
        until(lambda: heard, turn)


def test_two_pipelines_of_one_program_have_each_their_own_clients(place, keys, folder, message_of, until):
    create(folder / "second")
    second = str(folder / "second.d"), str(folder / "second")
    (folder / "second.d").mkdir(mode=0o700)
    model, heard = message_of("models"), []
    with (
        Publisher(MODELS, place()) as one,
        Publisher(MODELS, Endpoint.parse(*second)) as two,
        Subscriber(MODELS, Endpoint.parse(*second)) as reader,
        Subscriber(MODELS, Endpoint.parse(second[0], str(keys))) as stranger,
    ):
        until(lambda: heard, lambda: (one.send(model), two.send(model), heard.extend(reader.receive_all())))
        with pytest.raises(ServiceError, match="belong to another pipeline"):
            until(lambda: False, lambda: (two.send(model), stranger.receive(0.02)))


def test_sockets_with_keys_come_and_go_as_they_like(place, until):
    for _ in range(50):
        with Publisher(TRACKS, place()):
            pass
    with Publisher(TRACKS, place()) as tracks, Subscriber(TRACKS, place()) as reader:
        heard = []
        until(lambda: heard, lambda: (tracks.send(track(1)), heard.extend(reader.receive_all())))
    assert heard[0] == track(1)


@pytest.mark.parametrize("attach", ["subscribe", "control"])
def test_a_client_without_keys_gets_an_error_if_the_pipeline_requires_them(place, listener, attach, until):
    listens = listener("tracks" if attach == "subscribe" else "control")
    endpoint = str(place("none"))

    def attached():
        listens()
        if attach == "subscribe":
            with catstream.subscribe(endpoint, "tracks", timeout=0.2) as tracks, suppress(SilenceError):
                next(tracks)
        else:
            with catstream.control(endpoint, timeout=0.2) as pipeline, suppress(SilenceError):
                pipeline.pause()

    with pytest.raises(ServiceError, match=r"requires authentication.*--keys DIR"):
        until(attached)


@pytest.mark.parametrize(
    ("server", "client", "cause"),
    [
        ("keys", "wrong", "belong to another pipeline"),
        ("none", "keys", "has no keys: connect without keys"),
        ("keys", "none", "requires authentication"),
    ],
)
@pytest.mark.parametrize("name", ["tracks", "control"])
def test_a_client_that_can_never_connect_is_told_the_cause(place, until, server, client, cause, name):
    endpoint = place(client)
    listening = Publisher(TRACKS, place(server)) if name == "tracks" else Responder(CONTROL, place(server))
    connecting = Subscriber(TRACKS, endpoint) if name == "tracks" else Requester(CONTROL, endpoint)
    with listening, connecting, pytest.raises(ServiceError, match=cause):
        until(lambda: False, lambda: (listening._wait(0.01), connecting._wait(0.02)))


def test_a_client_waits_behind_a_tunnel_whose_pipeline_has_not_started(place, tcp, until):
    port = int(tcp.rpartition(":")[2]) + TRACKS.port
    accepted, heard = [], []
    with socket.create_server(("127.0.0.1", port)) as tunnel, Subscriber(TRACKS, place("watcher")) as reader:
        tunnel.setblocking(False)

        def turn():
            reader.receive(0.01)
            with suppress(BlockingIOError):
                accepted.append(tunnel.accept()[0].close())

        until(lambda: len(accepted) > 10, turn)
        tunnel.close()
        with Publisher(TRACKS, place()) as tracks:
            until(lambda: heard, lambda: (tracks.send(track(1)), heard.extend(reader.receive_all())))

"""Commands and their answers: each command is executed once, although messages are lost or repeated."""

import math
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise

import pytest
import zmq

from catstream.base.box import Box
from catstream.client.control import Control
from catstream.errors import BoxError, ServiceError
from catstream.wire import commands
from catstream.wire.channels import CHANNELS, CONTROL
from catstream.wire.codec import decode, encode
from catstream.wire.commands import Requester, Responder
from catstream.wire.messages import Answer, Command
from catstream.wire.rejects import rejected

PAUSE = Command("one", "pause")


def done(command):
    return Answer(command.id, True, "so it is", 7, Box(1.0, 2.0, 3.0, 4.0), 5)


@pytest.fixture
def answering(endpoint, turning):
    """Answers commands in a thread; gives a list of the commands as they come."""

    @contextmanager
    def serve(answer=done):
        def turn():
            for command in responder.receive_all():
                received.append(command)
                responder.answer(answer(command))

        received: list[Command] = []
        with Responder(CONTROL, endpoint) as responder, turning(turn):
            yield received

    return serve


@pytest.fixture
def raw(endpoint):
    """A client that speaks ZeroMQ only."""
    with zmq.Context.instance().socket(zmq.DEALER) as client:
        client.linger = 0
        client.connect(endpoint.address(CHANNELS["control"]))
        yield client


@pytest.fixture
def slow_network(monkeypatch):
    """Lets so much time pass before a question is repeated on the same connection that no test sees it."""
    monkeypatch.setattr(commands, "RETRY_BYTES_PER_SECOND", 1e-6)


@pytest.mark.usefixtures("slow_network")
def test_question_is_sent_again_once_it_is_connected_again(endpoint, answering, until):
    with ThreadPoolExecutor(1) as pool, Requester(CONTROL, endpoint) as requester:
        assert requester.ask(PAUSE, 0.1) is None, "no pipeline runs"
        answer = pool.submit(requester.ask, PAUSE, 500)
        with Responder(CONTROL, endpoint) as dies:
            assert until(lambda: dies.receive_all(0.1)) == [PAUSE]
        with answering() as received:
            assert answer.result(600) == done(PAUSE)
    assert received == [PAUSE]


def test_answer_is_received_after_its_sender_has_ended(endpoint, until):
    with Requester(CONTROL, endpoint) as requester:
        with Responder(CONTROL, endpoint) as ends:
            until(lambda: requester.send(PAUSE) or ends.receive_all(0.1))
            ends.answer(done(PAUSE))
        assert requester._monitor._events.poll(60_000)  # the end of the connection
        assert requester.receive(PAUSE.id, 0) == done(PAUSE)


def test_repeated_command_is_answered_again_and_executed_once(endpoint, raw, until):
    received, answers = [], []
    with Responder(CONTROL, endpoint) as responder:

        def turn():
            received.extend(responder.receive_all())
            answers.extend([decode(raw.recv(), Answer)] if raw.poll(20) else [])

        for _ in range(3):  # the second and the third arrive before the answer
            raw.send(encode(PAUSE))
        until(lambda: received, turn)
        responder.answer(done(PAUSE))
        raw.send(encode(PAUSE))
        until(lambda: len(answers) == 2, turn)
    assert received == [PAUSE]
    assert answers == [done(PAUSE)] * 2


@pytest.mark.parametrize(
    "parts",
    [[b""], [b"\xc1"], [b"", b"", b""], [encode(PAUSE), b"more"], [encode(done(PAUSE))]],
    ids=["nothing", "no msgpack", "many parts", "two parts", "an answer"],
)
def test_command_after_a_flood_of_invalid_ones_is_answered(answering, raw, parts):
    before = rejected()
    with answering() as received:
        for _ in range(50):
            raw.send_multipart(parts)
        raw.send(encode(PAUSE))
        assert raw.poll(20_000)
        assert decode(raw.recv(), Answer) == done(PAUSE)
    assert received == [PAUSE]
    assert rejected() - before == 50


def test_large_commands_are_spread_over_several_iterations(endpoint, raw, until):
    with Responder(CONTROL, endpoint, CONTROL.limit) as responder:
        raw.sndhwm = 0
        for _ in range(6):
            raw.send(bytes(900_000))
        counts = [rejected()]

        def turn():
            responder.receive_all()
            counts.append(rejected())

        until(lambda: counts[-1] - counts[0] == 6, turn)
    assert max(after - before for before, after in pairwise(counts)) <= 2


def test_commands_after_64_pending_ones_are_rejected_except_stop(endpoint, raw, until):
    with Responder(CONTROL, endpoint) as responder:
        received, answers = [], []

        def turn():
            received.extend(responder.receive_all())
            answers.extend([decode(raw.recv(), Answer)] if raw.poll(0) else [])

        for number in range(100):
            raw.send(encode(Command(f"{number}", "pause")))
            turn()
        until(lambda: len(answers) == 100 - 64, turn)
        raw.send(encode(Command("stop", "stop")))
        until(lambda: len(received) == 65, turn)
        for command in received:
            responder.answer(done(command))
        raw.send(encode(Command("99", "pause")))  # rejected before, so it may be sent again
        until(lambda: len(received) == 66, turn)
    assert [command.id for command in received] == [*map(str, range(64)), "stop", "99"]
    reason = "64 commands wait for the next frame: try again later"
    assert {(answer.done, answer.reason) for answer in answers[:36]} == {(False, reason)}


@pytest.mark.parametrize(
    ("send", "problem"),
    [
        (lambda control: control.set_box("10,10,0,20"), "at least 2 pixels, got 0 x 20"),
        (lambda control: control.set_box("nan,10,20,20"), "four finite numbers, got nan,10,20,20"),
        (lambda control: control.set_box((1, 2, 30, 40), time=math.inf), "time must be a finite number"),
        (lambda control: control.pause(-1.0), "seconds must be a finite number"),
    ],
)
def test_invalid_arguments_are_rejected_before_a_command_is_sent(endpoint, send, problem):
    with Control(endpoint) as control, pytest.raises((BoxError, ServiceError), match=problem):
        send(control)

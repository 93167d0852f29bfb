"""Commands and their answers: each is carried out once, whatever gets lost, and whoever else talks."""

from concurrent.futures import ThreadPoolExecutor, wait
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
def test_a_command_before_the_pipeline_runs_is_sent_as_soon_as_it_does(endpoint, answering):
    with ThreadPoolExecutor(1) as pool, Requester(CONTROL, endpoint) as requester:
        assert requester.ask(PAUSE, 0.3) is None
        answer = pool.submit(requester.ask, PAUSE, 60)
        assert not wait([answer], 0.2).done
        with answering() as heard:
            assert answer.result(500) == done(PAUSE)
    assert heard == [PAUSE]


@pytest.mark.usefixtures("slow_network")
def test_a_question_whose_connection_broke_is_sent_again_as_soon_as_there_is_another(endpoint, answering, until):
    with ThreadPoolExecutor(1) as pool, Requester(CONTROL, endpoint) as requester:
        with Responder(CONTROL, endpoint) as dies:
            answer = pool.submit(requester.ask, PAUSE, 60)
            assert until(lambda: dies.receive_all(0.1)) == [PAUSE]
        with answering() as heard:
            assert answer.result(500) == done(PAUSE)
    assert heard == [PAUSE]


def test_an_answer_is_received_also_if_its_sender_has_ended_before_it_was_read(endpoint, until):
    with Requester(CONTROL, endpoint) as requester:
        with Responder(CONTROL, endpoint) as ends:
            until(lambda: requester.send(PAUSE) or ends.receive_all(0.1))
            ends.answer(done(PAUSE))
        assert requester._monitor._events.poll(60_000)  # the end of the connection
        assert requester.receive(PAUSE.id, 0) == done(PAUSE)


def test_a_repeated_command_is_answered_again_and_executed_once(endpoint, raw, until):
    with Responder(CONTROL, endpoint) as responder:
        heard = []
        for _ in range(3):  # on its way when the first is taken, and after its answer
            raw.send(encode(PAUSE))
        until(lambda: heard, lambda: heard.extend(responder.receive_all()))
        until(lambda: not heard[1:] and not raw.poll(20), lambda: heard.extend(responder.receive_all()))
        responder.answer(done(PAUSE))
        raw.send(encode(PAUSE))
        answers = []

        def turn():
            heard.extend(responder.receive_all())
            answers.extend([decode(raw.recv(), Answer)] if raw.poll(20) else [])

        until(lambda: len(answers) == 2, turn)
    assert heard == [PAUSE]
    assert answers == [done(PAUSE)] * 2


@pytest.mark.parametrize(
    "parts",
    [[b""], [b"\xc1"], [b"", b"", b""], [encode(PAUSE), b"more"], [encode(done(PAUSE))]],
    ids=["nothing", "no msgpack", "many parts", "two parts", "an answer"],
)
def test_a_flood_of_invalid_commands_is_counted_and_the_next_one_is_answered(answering, raw, parts):
    before = rejected()
    with answering() as heard:
        for _ in range(50):
            raw.send_multipart(parts)
        raw.send(encode(PAUSE))
        assert raw.poll(20_000)
        assert decode(raw.recv(), Answer) == done(PAUSE)
    assert heard == [PAUSE]
    assert rejected() - before == 50


def test_of_a_flood_of_large_commands_the_most_waits_for_the_next_turn(endpoint, raw, until):
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


def test_of_a_flood_of_commands_64_wait_others_are_rejected_and_stop_passes(endpoint, raw, until):
    with Responder(CONTROL, endpoint) as responder:
        heard, answers = [], []

        def turn():
            heard.extend(responder.receive_all())
            answers.extend([decode(raw.recv(), Answer)] if raw.poll(0) else [])

        for number in range(100):
            raw.send(encode(Command(f"{number}", "pause")))
            turn()
        until(lambda: len(answers) == 100 - 64, turn)
        raw.send(encode(Command("stop", "stop")))
        until(lambda: len(heard) == 65, turn)
        for command in heard:
            responder.answer(done(command))
        raw.send(encode(Command("99", "pause")))  # rejected before, so it may be sent again
        until(lambda: len(heard) == 66, turn)
    assert [command.id for command in heard] == [*map(str, range(64)), "stop", "99"]
    reason = "64 commands wait for the next frame: try again later"
    assert {(answer.done, answer.reason) for answer in answers[:36]} == {(False, reason)}


@pytest.mark.parametrize(
    ("box", "problem"),
    [("10,10,0,20", "at least 2 pixels, got 0 x 20"), ("nan,10,20,20", "four finite numbers, got nan,10,20,20")],
)
def test_an_invalid_box_is_rejected_before_it_is_sent(endpoint, box, problem):
    with Control(endpoint) as control, pytest.raises(BoxError, match=problem):
        control.set_box(box)


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf")])
def test_an_invalid_number_of_seconds_is_rejected_before_it_is_sent(endpoint, seconds):
    with Control(endpoint) as control:
        with pytest.raises(ServiceError, match="seconds must be a finite number"):
            control.pause(seconds)
        with pytest.raises(ServiceError, match="time must be a finite number"):
            control.set_box((1, 2, 30, 40), time=seconds)

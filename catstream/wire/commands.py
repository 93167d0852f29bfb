"""Questions and their answers (`control`, `registry`): each is taken once, though its answer may get lost.

One process binds a ROUTER socket (`Responder`); any number of clients connect DEALER sockets (`Requester`). A client
sends a question again until an answer with its `id` arrives: as soon as it is connected again if the connection broke,
otherwise after a time that suits the size of the question. The responder remembers its last 64 answers, and repeats the
answer to a question that it has answered already. A command is a question that asks for an action. At most 64 questions
wait: any further command is rejected, except for "stop".
"""

from __future__ import annotations

import contextlib
from time import monotonic
from typing import Generic, Protocol, TypeVar, cast

import zmq

from catstream.base.clock import RunningClock
from catstream.wire.channels import Channel
from catstream.wire.endpoint import Endpoint
from catstream.wire.go_back_n import PATIENCE_SECONDS
from catstream.wire.messages import Answer as CommandAnswer
from catstream.wire.messages import Command
from catstream.wire.socket import ChannelSocket

LOOK_SECONDS = 0.05  #: from one look at the connection to the next
ANSWER_SECONDS = 5.0  #: limit for an answer, by default
RETRY_BYTES_PER_SECOND = 1e6  #: of a slow network: a large question is sent again after so much longer
_MAX_QUESTIONS = 64  # that wait, that are remembered with their answers, and that are received at once
_LONGEST_QUESTION = 1 << 20  # bytes; once so many were received, the other questions wait
_MOST_QUEUED = 256 << 20  # bytes of questions that a socket queues for each client


class _HasId(Protocol):
    @property
    def id(self) -> str: ...


Question = TypeVar("Question", bound=_HasId)
Answer = TypeVar("Answer", bound=_HasId)


class Requester(ChannelSocket[Question | Answer], Generic[Question, Answer]):
    """Sends questions, the channel's first kind of message, and receives answers, its second; it connects."""

    def __init__(self, channel: Channel[Question | Answer], endpoint: Endpoint) -> None:
        super().__init__(zmq.DEALER, channel, endpoint, high_water_mark=_MAX_QUESTIONS)
        self._answer_kind = cast(type[Answer], channel.messages[1])
        self._in_transit = False  # whether a question was sent, and the connection did not break since
        # With ZMQ_IMMEDIATE, which queues nothing before there is a connection, libzmq would also drop an answer that
        # was not read yet if the connection ends, as after "stop".
        self._is_connected = False
        self._socket.set(zmq.LINGER, 0)  # a question without a receiver is dropped
        self._connect()

    def ask(self, question: Question, seconds: float) -> Answer | None:
        """Send a question until it is answered; None if no answer arrived in time."""
        data, clock = self._encode(question), RunningClock()
        now = repeat_at = 0.0
        while now < seconds:
            if now >= repeat_at or not self._in_transit:
                self._send(data)
                repeat_at = now + PATIENCE_SECONDS + len(data) / RETRY_BYTES_PER_SECOND
            if (answer := self.receive(question.id, min(seconds - now, LOOK_SECONDS))) is not None:
                return answer
            now = clock()
        return None

    def send(self, question: Question) -> None:
        """Send a question once, without waiting for a connection or for the answer: `receive` returns it."""
        self._send(self._encode(question))

    def receive(self, question: str, seconds: float) -> Answer | None:
        """The answer to the question with this id if it arrives in time; late answers to others are dropped."""
        deadline = monotonic() + seconds
        while self._wait(max(0.0, deadline - monotonic())):
            answer = self._decode(self._socket.recv(), self._answer_kind)
            if answer is not None and answer.id == question:
                return answer
        return None

    def _send(self, data: bytes) -> None:
        self._read_events()  # those from before do not concern this question
        self._in_transit = False
        with contextlib.suppress(zmq.Again):  # the responder does not read
            if self._is_connected:
                self._socket.send(data, zmq.NOBLOCK)
                self._in_transit = True

    def _connected(self) -> None:
        self._is_connected = True

    def _disconnected(self) -> None:
        self._is_connected = self._in_transit = False


class Responder(ChannelSocket[Question | Answer], Generic[Question, Answer]):
    """Receives questions of at most `longest` bytes from any number of clients, and answers them; it binds."""

    def __init__(
        self, channel: Channel[Question | Answer], endpoint: Endpoint, longest: int = _LONGEST_QUESTION
    ) -> None:
        super().__init__(zmq.ROUTER, channel, endpoint, min(_MAX_QUESTIONS, _MOST_QUEUED // longest))
        self._socket.set(zmq.MAXMSGSIZE, longest)
        self._question_kind = cast(type[Question], channel.messages[0])
        self._waiting: dict[str, bytes] = {}  # the peer that asked last, by the id of its question
        self._answers: dict[str, bytes] = {}  # the last ones, by the id of their question
        self._bind()

    def receive_all(self, seconds: float = 0.0) -> list[Question]:
        """The new questions, oldest first; each has to be answered. Repeated questions are left out.

        It waits so many seconds for the first one. A flood does not stop the process: the rest waits for the next call.
        """
        questions: list[Question] = []
        received = size = 0
        while received < _MAX_QUESTIONS and size <= _LONGEST_QUESTION and self._wait(seconds):
            peer, data = self._receive_from_peer()
            received, size = received + 1, size + (len(data) if data is not None else 0)
            question = self._decode(data, self._question_kind) if data is not None else None
            if question is not None and self._accept(question, peer):
                questions.append(question)
            seconds = 0.0
        return questions

    def answer(self, answer: Answer) -> None:
        """Answer a question, now and whenever it is repeated."""
        self._answers[answer.id] = data = self._encode(answer)
        if len(self._answers) > _MAX_QUESTIONS:
            del self._answers[next(iter(self._answers))]
        if (peer := self._waiting.pop(answer.id, None)) is not None:
            self._send(peer, data)

    def _accept(self, question: Question, peer: bytes) -> bool:
        """Note the peer; returns whether the question is new. An earlier answer is repeated."""
        if (answer := self._answers.get(question.id)) is not None:
            self._send(peer, answer)
            return False
        is_waiting = question.id in self._waiting
        stops = isinstance(question, Command) and question.verb == "stop"
        if is_waiting or len(self._waiting) < (2 if stops else 1) * _MAX_QUESTIONS:
            self._waiting[question.id] = peer
            return not is_waiting
        if isinstance(question, Command):
            full = f"{_MAX_QUESTIONS} commands wait for the next frame: try again later"
            self._send(peer, self._encode(CommandAnswer(question.id, False, full)))
        return False

    def _send(self, peer: bytes, data: bytes) -> None:
        with contextlib.suppress(zmq.Again):  # a client that does not read asks again
            self._socket.send_multipart([peer, data], zmq.NOBLOCK)

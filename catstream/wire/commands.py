"""Request/reply channels (`control`, `registry`): each question is handled once, even if its answer is lost.

One process binds a ROUTER socket (`Responder`); any number of clients connect DEALER sockets (`Requester`). A client
repeats a question until an answer with its `id` arrives: at once after a reconnection, otherwise after a timeout that
grows with the size of the question. The responder stores its last 64 answers, and sends the stored answer if a question
is repeated. A command is a question that requests an action. At most 64 questions wait: further commands are rejected,
except for "stop".
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

LOOK_SECONDS = 0.05  #: interval between two checks of the connection
ANSWER_SECONDS = 5.0  #: default timeout for an answer
RETRY_BYTES_PER_SECOND = 1e6  #: assumed network speed, which extends the timeout of large questions
_MAX_QUESTIONS = 64  # limit for waiting questions, stored answers, and questions received at once
_LONGEST_QUESTION = 1 << 20  # bytes of a question, and total after which the next questions wait
_MOST_QUEUED = 256 << 20  # bytes of questions that a socket queues for each client


class _HasId(Protocol):
    @property
    def id(self) -> str: ...


Question = TypeVar("Question", bound=_HasId)
Answer = TypeVar("Answer", bound=_HasId)


class Requester(ChannelSocket[Question | Answer], Generic[Question, Answer]):
    """Connects, sends questions (the channel's first kind of message) and receives answers (its second)."""

    def __init__(self, channel: Channel[Question | Answer], endpoint: Endpoint) -> None:
        super().__init__(zmq.DEALER, channel, endpoint, high_water_mark=_MAX_QUESTIONS)
        self._answer_kind = cast(type[Answer], channel.messages[1])
        self._in_transit = False  # whether a question was sent on the present connection
        # Not ZMQ_IMMEDIATE: when the connection ends, as after "stop", libzmq would drop an unread answer.
        self._is_connected = False
        self._socket.set(zmq.LINGER, 0)  # a question without a receiver is dropped
        self._connect()

    def ask(self, question: Question, seconds: float) -> Answer | None:
        """Send a question repeatedly until it is answered; None after `seconds`."""
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
        """Send a question once, without waiting for a connection or the answer, which `receive` returns."""
        self._send(self._encode(question))

    def receive(self, question: str, seconds: float) -> Answer | None:
        """The answer to the question with this id, None after `seconds`; answers to other questions are dropped."""
        deadline = monotonic() + seconds
        while self._wait(max(0.0, deadline - monotonic())):
            answer = self._decode(self._socket.recv(), self._answer_kind)
            if answer is not None and answer.id == question:
                return answer
        return None

    def _send(self, data: bytes) -> None:
        self._read_events()  # an earlier disconnection does not concern this question
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
    """Binds, receives questions of at most `longest` bytes from any number of clients, and answers them."""

    def __init__(
        self, channel: Channel[Question | Answer], endpoint: Endpoint, longest: int = _LONGEST_QUESTION
    ) -> None:
        super().__init__(zmq.ROUTER, channel, endpoint, min(_MAX_QUESTIONS, _MOST_QUEUED // longest))
        self._socket.set(zmq.MAXMSGSIZE, longest)
        self._question_kind = cast(type[Question], channel.messages[0])
        self._waiting: dict[str, bytes] = {}  # last sender of each unanswered question, by id
        self._answers: dict[str, bytes] = {}  # last answers, by the id of the question
        self._bind()

    def receive_all(self, seconds: float = 0.0) -> list[Question]:
        """The new questions, oldest first; the caller must answer each. Repeated questions are omitted.

        Waits up to `seconds` for the first one. A flood must not block the process: the rest waits for the next call.
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
        """Answer a question, now and each time it is repeated."""
        self._answers[answer.id] = data = self._encode(answer)
        if len(self._answers) > _MAX_QUESTIONS:
            del self._answers[next(iter(self._answers))]
        if (peer := self._waiting.pop(answer.id, None)) is not None:
            self._send(peer, data)

    def _accept(self, question: Question, peer: bytes) -> bool:
        """Return True if a question is new, and store its sender; repeat the answer to an answered one."""
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
        with contextlib.suppress(zmq.Again):  # the queue is full: the client repeats the question
            self._socket.send_multipart([peer, data], zmq.NOBLOCK)

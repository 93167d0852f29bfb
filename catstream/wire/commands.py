"""Commands and their answers (`control`): each command is carried out once, though its answer may get lost.

The detector binds a ROUTER socket (`Responder`); any number of clients connect DEALER sockets (`Requester`). A client
sends a command again until an answer with its `id` arrives. The responder remembers its last 64 answers, and repeats
the answer to a command that it has carried out already. At most 64 commands wait; any further one is dropped and sent
again by its client.
"""

from __future__ import annotations

import contextlib
from time import monotonic

import zmq

from catstream.messages import Answer, Command
from catstream.wire.channels import CONTROL
from catstream.wire.codec import encode
from catstream.wire.endpoint import Endpoint
from catstream.wire.socket import ChannelSocket

__all__ = ["Requester", "Responder"]

_MAX_COMMANDS = 64  # that wait, that are remembered with their answers, and that are received at once
_REPEAT_SECONDS = 0.2


class Requester(ChannelSocket[Command | Answer]):
    """Sends commands, one at a time, and waits for the answer to each."""

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(zmq.DEALER, CONTROL, endpoint, high_water_mark=_MAX_COMMANDS)
        self._socket.set(zmq.LINGER, 0)  # a command that nobody received is given up
        self._socket.set(zmq.IMMEDIATE, 1)
        self._connect()

    def ask(self, command: Command, seconds: float) -> Answer | None:
        """Send a command until it is answered; None if no answer arrived in time."""
        data, deadline = encode(command), monotonic() + seconds
        while (left := deadline - monotonic()) > 0:
            with contextlib.suppress(zmq.Again):  # nobody is connected yet
                self._socket.send(data, zmq.NOBLOCK)
            answer = self._receive(command.id, min(left, _REPEAT_SECONDS))
            if answer is not None:
                return answer
        return None

    def _receive(self, command: str, seconds: float) -> Answer | None:
        """The answer to a command if it arrives in time; late answers to others are dropped."""
        deadline = monotonic() + seconds
        while (left := deadline - monotonic()) > 0:
            answer = self._decode(self._socket.recv(), Answer) if self._wait(left) else None
            if answer is not None and answer.id == command:
                return answer
        return None


class Responder(ChannelSocket[Command | Answer]):
    """Receives commands from any number of clients and answers them; it binds."""

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(zmq.ROUTER, CONTROL, endpoint, high_water_mark=_MAX_COMMANDS)
        self._waiting: dict[str, bytes] = {}  # the peer that asked last, by the id of its command
        self._answers: dict[str, bytes] = {}  # the last ones, by the id of their command
        self._bind()

    def receive_all(self) -> list[Command]:
        """The new commands, oldest first; each has to be answered. A command that was repeated is not among them."""
        commands = []
        for _ in range(_MAX_COMMANDS):  # the rest waits for the next call: a flood does not stop the process
            if not self._wait(0):
                break
            peer, data = self._receive_from_peer()
            command = self._decode(data, Command) if data is not None else None
            if command is not None and self._is_new(command, peer):
                commands.append(command)
        return commands

    def answer(self, answer: Answer) -> None:
        """Answer a command, now and whenever it is repeated."""
        self._answers[answer.id] = data = encode(answer)
        if len(self._answers) > _MAX_COMMANDS:
            del self._answers[next(iter(self._answers))]
        if (peer := self._waiting.pop(answer.id, None)) is not None:
            self._send(peer, data)

    def _is_new(self, command: Command, peer: bytes) -> bool:
        """Whether a command has to be carried out; one that was answered is answered again."""
        if (answer := self._answers.get(command.id)) is not None:
            self._send(peer, answer)
            return False
        known = command.id in self._waiting
        if known or len(self._waiting) < _MAX_COMMANDS:
            self._waiting[command.id] = peer
            return not known
        return False

    def _send(self, peer: bytes, data: bytes) -> None:
        with contextlib.suppress(zmq.Again):  # a client that does not read asks again
            self._socket.send_multipart([peer, data], zmq.NOBLOCK)

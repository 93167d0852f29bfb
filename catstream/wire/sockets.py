"""Sockets: senders and receivers of a channel, and the only place that knows ZeroMQ.

An acknowledged channel (`Sender`, `Receiver`) loses nothing. The sender keeps every message
until the receiver says that it is stored, at most `window` of them. A receiver that finds one
missing, or that is new, answers with its `Position`; the sender goes on from there, whatever
was on the way. A sender that hears nothing asks again. So either side may die, and the
messages are still taken once each, in order.

The other channels (`Publisher`, `Subscriber`) never wait for a reader. Where the newest
counts, the last message is sent again to everyone who comes late, and once to all when
nothing newer followed: a burst may have cost a reader the last of it. So a reader must take
the same message twice calmly.

Commands (`Requester`, `Responder`) are asked again until they are answered. The responder
remembers its answers, so that a command whose answer was lost is not carried out twice.

Where the endpoint has keys, all is encrypted, who listens is known by its key, and who connects
needs one that may (`catstream.wire.gate`). What is refused is counted and dropped (`catstream.wire.refusals`).
"""

from __future__ import annotations

import contextlib
import itertools
from collections import deque
from collections.abc import Callable, Iterable
from time import monotonic
from typing import Any, Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from catstream.errors import ProtocolError, ServiceError, SetBackError
from catstream.messages import Answer, Command, End, Position, Stored
from catstream.wire.channels import CHANNELS, Channel
from catstream.wire.codec import decode, encode, opening
from catstream.wire.endpoint import Endpoint
from catstream.wire.gate import GATE
from catstream.wire.refusals import count, refuse

__all__ = ["Publisher", "Receiver", "Requester", "Responder", "Sender", "Subscriber"]

_HELLO = b""
_PATIENCE = 0.2  # seconds of silence after which a sender asks where the receiver is, a publisher says it once more
_LINGER = 2000  # milliseconds that a closed socket still has for its last messages
_NEWEST = 8  # messages of a burst that are on their way at once where only the newest counts
_SAMPLES = 65536  # that a sender remembers, at most one a message: as many as `run.lag_frames` may be
_COMMANDS = 64  # that wait, or were answered last, and that are taken in at once
_CHANGES = 1000  # readers that come or go, taken in at once
_LONGEST_WISH = 4096  # bytes of what a reader says: who it is, and what it subscribes to
_READER = b"\xffreader "  # begins the topic by which a subscriber is known that announced itself; no message does
_HANDSHAKE = 5000  # milliseconds that a peer has to say who it is

#: What ZeroMQ tells of a connection, where it is asked to.
_EVENTS = (
    zmq.EVENT_MONITOR_STOPPED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)

_OTHER_MECHANISM = 0x11000002  # ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH: one side has keys, the other has none

_NUMBERS = itertools.count(1)  # of sockets that are told of connections


class _Socket:
    """One ZeroMQ socket with limits on everything that could grow."""

    def __init__(self, kind: int, channel: str, endpoint: Endpoint, depth: int) -> None:
        self.channel: Channel = CHANNELS[channel]
        self.refused = 0  #: messages that were dropped because they were not what the channel carries
        self._endpoint = endpoint
        self._listens = False
        self._domain = b""  # by which the gate knows it, where it listens and there are keys
        context: Any = zmq.Context.instance()  # its types do not know a socket's options
        self._socket = context.socket(kind)
        self._socket.linger = _LINGER
        self._socket.ipv6 = "[" in str(endpoint)
        self._socket.sndhwm = self._socket.rcvhwm = depth
        self._socket.maxmsgsize = self.channel.limit
        self._socket.handshake_ivl = _HANDSHAKE
        # No heartbeats: ZeroMQ aborts the process where one is due to a peer that went away while the queue of
        # its messages was full (libzmq issue 4767). On one machine the kernel tells when a peer is gone; of a host
        # that lost its power nobody tells: TCP asks there, and says so after 11 s, or once the host is up again.
        self._socket.tcp_keepalive, self._socket.tcp_keepalive_idle = 1, 5
        self._socket.tcp_keepalive_intvl, self._socket.tcp_keepalive_cnt = 2, 3
        self._socket.reconnect_ivl, self._socket.reconnect_ivl_max = 20, 500
        self._events: Any = None  # hears of connections
        self._left = False  # whether one ended

    def _bind(self, sender: str | None = None) -> None:
        address = self._endpoint.listening(self.channel, sender)
        keys = self._endpoint.keys
        try:
            if keys is not None:
                self._socket.curve_secretkey, self._socket.curve_server = keys.listening(), True
                self._domain = self._socket.zap_domain = GATE.guard(self.channel, keys)
                self._socket.zap_enforce_domain = True  # were the gate ever gone, nobody comes in
            if self._endpoint.taken(self.channel, sender):
                raise zmq.ZMQError(zmq.EADDRINUSE)
            self._watch()
            self._socket.bind(address)
            self._listens = True
        except zmq.ZMQError as error:
            self.close()
            raise ServiceError(
                f"cannot listen on {address} ({error.strerror}): another pipeline may be running there, "
                "wait for it or give another endpoint (--set run.endpoint=...)"
            ) from None
        except ServiceError:
            self.close()
            raise

    def _connect(self) -> None:
        if (keys := self._endpoint.keys) is not None:
            self._socket.curve_serverkey = keys.server
            self._socket.curve_publickey, self._socket.curve_secretkey = keys.public, keys.secret
        self._watch()
        for sender in self.channel.senders:
            self._socket.connect(self._endpoint.address(self.channel, sender))

    def _decode(self, data: bytes | memoryview, *kinds: type, check: Callable[[Any], None] | None = None) -> Any:
        """The message, or None for what a stranger sent: counted, said once, dropped."""
        try:
            message = decode(data, *kinds)
            if check is not None:
                check(message)
        except ProtocolError as error:
            self._drop(error.reason, error)
            return None
        return message

    def _from_peer(self) -> tuple[bytes, memoryview | None]:
        """Who sends, and what, of a ROUTER's next message; None where it has not the one part that all have."""
        peer = self._socket.recv()
        data = self._socket.recv(copy=False).buffer
        parts = 1
        while self._socket.rcvmore:  # one by one: a stranger may send any number
            self._socket.recv(copy=False)
            parts += 1
        if parts > 1:
            self._drop("parts", f"it has {parts} parts")
            return peer, None
        return peer, data

    def _drop(self, reason: str, text: object) -> None:
        """Count a message that is not what the channel carries, and say so once."""
        self.refused += 1
        refuse(self.channel.name, reason, f"a message was dropped: {text}")

    def _wait(self, seconds: float) -> bool:
        self._look()
        return bool(self._socket.poll(max(0, round(seconds * 1000))))

    def _watch(self) -> None:
        """Have ZeroMQ tell of connections from now on."""
        address = f"inproc://events-{next(_NUMBERS)}"  # a closed one may be there a little longer
        self._socket.monitor(address, _EVENTS)
        self._events = self._socket.context.socket(zmq.PAIR)
        self._events.rcvhwm = 0  # with a limit ZeroMQ would stand still until they are taken
        self._events.connect(address)

    def _look(self, milliseconds: int = 0, until: int = 0) -> None:
        """Take in what became of connections, waiting so long for a certain event.

        Raises
        ------
        ServiceError
            If this end connects, and is not let in: its key may not take part, or it has none where keys are asked for.
        """
        while self._events is not None and self._events.poll(milliseconds):
            told = recv_monitor_message(self._events)
            event = told["event"]
            if event == zmq.EVENT_DISCONNECTED:
                self._left = True
                if self._listens:
                    count("disconnected")
            elif event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                if not self._listens:  # a listener's gate has counted it
                    raise ServiceError(
                        f"{self._endpoint} does not let this key take part in {self.channel.name}: "
                        "ask who runs it for one that may (catstream keys allow)"
                    )
            elif told["value"] == _OTHER_MECHANISM and not self._listens and self._endpoint.keys is None:
                raise ServiceError(
                    f"the pipeline at {self._endpoint} asks for keys, and none were given: give a folder of keys "
                    "that it lets in (--keys DIR, see catstream keys)"
                )
            elif event != zmq.EVENT_MONITOR_STOPPED and self._listens:
                needed = "does not speak ZeroMQ" if self._endpoint.keys is None else "has not the pipeline's keys"
                refuse(self.channel.name, "handshake", f"a stranger was turned away: it {needed}")
            if event == until:
                break

    def fileno(self) -> int:
        """Readable when something may have come since this socket was last asked whether a message is here."""
        return self._socket.fd

    def close(self) -> None:
        """Send what is on its way, then close; the address is free for the next one."""
        if not self._listens and not self._socket.closed:
            self._socket.disable_monitor()
        self._socket.close()
        # ZeroMQ stops listening some time later, and would take the next one's socket file with it. To unbind
        # first would be sooner, but drops what is on its way. Its thread stands still for ever where it has
        # something to tell and nobody to tell it to: so nobody leaves before it stops to tell.
        if self._listens:
            self._look(2 * _LINGER, until=zmq.EVENT_MONITOR_STOPPED)
            self._listens = False
        if self._events is not None:
            self._events.close()
            self._events = None
        if self._domain:
            GATE.leave(self._domain)
            self._domain = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Sender(_Socket):
    """The sending side of an acknowledged channel.

    sent     newest seq that was given to `send`
    settled  newest seq that the receiver will not ask for again while it lives
    stored   newest seq that survives the receiver's death: less than `settled` while its disk takes nothing
    taken    newest seq that the receiver has taken
    version  newest sample that the receiver has made
    """

    def __init__(self, channel: str, endpoint: Endpoint, window: int) -> None:
        super().__init__(zmq.DEALER, channel, endpoint, depth=window + 1)
        self.sent = self.settled = self.stored = self.taken = self.version = 0
        self._made: deque[tuple[int, int]] = deque(maxlen=_SAMPLES)  # seq that led to a sample, and which
        self._led_to = 0  # the sample that `made` told of last
        self._window = window
        self._waiting: deque[tuple[int, bytes]] = deque()  # not stored yet, oldest first
        self._on_the_way = 0  # how many of them were handed to the socket
        self._known = 0  # what the receiver can have stored from the sender before this one
        self._heard = monotonic()
        self._socket.immediate = True  # nothing is handed over before somebody is there
        self._connect()

    def position(self) -> Position | None:
        """Ask once where the receiver is; None where it does not answer yet."""
        self._say_hello()
        if self._wait(_PATIENCE):
            answer = self._decode(self._socket.recv(), Stored, Position)
            return answer if isinstance(answer, Position) else None
        return None

    def resume(self, seq: int, known: int) -> None:
        """Go on after message `seq` of a sender before this one, of which the receiver has stored `known`."""
        self.sent = self.settled = self.stored = self.taken = seq
        self._known = known + self._window  # what the sender before this one had on its way may be stored by now

    def made(self, seq: int) -> int:
        """Newest sample that the messages up to `seq` led to; not to be asked again of those before.

        Where the receiver did not answer one by one, a sample counts as of the first message that it may be of.
        """
        while self._made and self._made[0][0] <= seq:
            self._led_to = self._made.popleft()[1]
        return self._led_to

    def send(self, message: Any) -> bool:
        """Send a message with the next seq, without waiting; False where the window is full."""
        self.listen(0)
        if len(self._waiting) >= self._window:
            return False
        self._waiting.append((message.seq, encode(message)))
        self.sent = message.seq
        self._hand_over()
        return True

    def listen(self, seconds: float) -> None:
        """Take in acknowledgements, waiting at most this long for the first."""
        if self._wait(seconds):
            while True:
                try:
                    answer = self._decode(self._socket.recv(zmq.NOBLOCK), Stored, Position)
                except zmq.Again:
                    break
                self._take(answer)
        elif self._waiting and monotonic() - self._heard > _PATIENCE:
            self._say_hello()
        self._hand_over()

    def _take(self, answer: Stored | Position | None) -> None:
        if answer is None:
            return
        if answer.seq > max(self.sent, self._known):
            raise ProtocolError(
                f"the receiver of {self.channel.name} has stored message {answer.seq}, only {self.sent} were sent: "
                "it holds another stream, start it anew or this process with --resume"
            )
        if isinstance(answer, Stored) and (answer.seq < self.settled or answer.taken < self.taken):
            self._drop("acknowledgement", f"it was said before that {self.taken} were taken and {self.settled} stored")
            return
        if isinstance(answer, Position) and answer.seq < self.settled:
            raise SetBackError(
                f"the receiver of {self.channel.name} had {self.settled} messages and now has {answer.seq}: "
                "what came between is made again from the source"
            )
        self._heard = monotonic()
        if answer.version > self.version:
            self.version = answer.version
            self._made.append((self.taken + 1, answer.version))
        while self._waiting and self._waiting[0][0] <= answer.seq:
            self._waiting.popleft()
            self._on_the_way = max(self._on_the_way - 1, 0)
        self.settled = max(self.settled, min(answer.seq, self.sent))
        self.stored = max(self.stored, min(answer.seq - answer.unsaved, self.sent))
        if isinstance(answer, Position):
            self._on_the_way = 0
            self.taken = self.settled
        else:
            self.taken = min(answer.taken, self.sent)

    def _hand_over(self) -> None:
        while self._on_the_way < len(self._waiting):
            try:
                self._socket.send(self._waiting[self._on_the_way][1], zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            self._on_the_way += 1

    def _say_hello(self) -> None:
        self._heard = monotonic()
        with contextlib.suppress(zmq.Again):  # nobody there yet: it is asked again
            self._socket.send(_HELLO, zmq.NOBLOCK)


class Receiver(_Socket):
    """The receiving side of an acknowledged channel; it binds.

    Parameters
    ----------
    position : where the stream goes on: the next message taken is the one after `position.seq`
    store : stores all that was taken, and returns where that is; called where a sender asks, so that one
        that starts anew has nothing to repeat. Without it the answer is what was stored last
    check : raises ProtocolError for a message that is not of this stream
    """

    def __init__(
        self,
        channel: str,
        endpoint: Endpoint,
        position: Position,
        window: int,
        store: Callable[[], Position] | None = None,
        check: Callable[[Any], None] | None = None,
    ) -> None:
        super().__init__(zmq.ROUTER, channel, endpoint, depth=window + 1)
        self.taken = position.seq
        self._position, self._store, self._check, self._window = position, store, check, window
        self._peer: bytes | None = None  # whose message was taken last: what is stored concerns nobody else
        self._asked = 0.0  # when a message was last found missing
        self._ended = False  # whether the sender has sent its end
        self._bind()

    def receive(self, seconds: float) -> Any:
        """The next message in order, or None where none came in time."""
        if not self._wait(seconds):
            return None
        peer, data = self._from_peer()
        if data is None:
            return None
        if not len(data):
            if self._store is not None and self._position.seq < self.taken:
                self._position = self._store()
            self._answer(peer, self._position)
            return None
        message = self._decode(data, *self.channel.messages, check=self._check)
        if message is None:
            return None
        if message.seq <= self.taken:  # it was asked and sent all again: it does not know what is taken
            self._answer(peer, self._stored())
            return None
        if message.seq > self.taken + 1:
            if message.seq > self.taken + self._window + 1:  # more than a sender may have on its way
                self._drop("sequence", f"message {message.seq} came after {self.taken}")
            if monotonic() - self._asked > _PATIENCE:
                self._asked = monotonic()
                self._answer(peer, self._position)
            return None
        self._asked, self._peer, self._left = 0.0, peer, False
        self.taken = message.seq
        self._ended = isinstance(message, End)
        return message

    @property
    def fed(self) -> bool:
        """Whether the one that sent last is still there, and has not sent its end."""
        self._look()
        return self._peer is not None and not self._ended and not self._left

    def acknowledge(self, position: Position) -> None:
        """Say that all is taken up to the last message, and stored up to `position.seq`, but for `position.unsaved`."""
        self._position = position
        if self._peer is not None:
            self._answer(self._peer, self._stored())

    def close(self) -> None:
        """Close, after the sender where it has sent its end: a connection that breaks may cost it the last answer."""
        if self._ended and not self._left:
            self._look(_LINGER, until=zmq.EVENT_DISCONNECTED)
        super().close()

    def _stored(self) -> Stored:
        at = self._position
        return Stored(at.seq, self.taken, at.version, at.unsaved)

    def _answer(self, peer: bytes, message: Stored | Position) -> None:
        with contextlib.suppress(zmq.Again):  # a sender that does not listen asks again
            self._socket.send_multipart([peer, encode(message)], zmq.NOBLOCK)


class Publisher(_Socket):
    """Sends to anyone who listens, and waits for no one.

    Parameters
    ----------
    sender : which of the channel's senders this is, where there are several
    greeting : what everyone who comes gets first; on a channel that keeps every message
    """

    def __init__(self, channel: str, endpoint: Endpoint, sender: str | None = None, greeting: Any = None) -> None:
        row = CHANNELS[channel]
        newest = row.keeps == "newest"
        super().__init__(zmq.XPUB, channel, endpoint, depth=_NEWEST if newest else row.depth)
        self._socket.maxmsgsize = _LONGEST_WISH
        self._openings = {b"", *map(opening, row.messages)}  # what readers may subscribe to
        self._wanted: set[bytes] = set()  # what messages must begin with for somebody to get them
        self._expected: set[bytes] = set()  # topics of announced subscribers that are not connected yet
        self._last: bytes | None = None if greeting is None else encode(greeting)
        self._repeat = float("inf")  # when the last message is due once more
        self._newest = newest
        self._socket.xpub_verbose = True  # hear of every reader, also of one that asks for what others get
        self._bind(sender)

    def send(self, message: Any) -> None:
        """Send to all who listen now, and where the newest counts to those who come later."""
        if not self._newest:
            self.welcome()
            if self._wanted:
                self._socket.send(encode(message), copy=False)
            return
        self._last, self._repeat = encode(message), monotonic() + _PATIENCE
        self._socket.send(self._last, copy=False)
        self.welcome()

    @property
    def heard(self) -> bool:
        """Whether somebody listened when `send` or `welcome` was last called."""
        return bool(self._wanted)

    def expect(self, readers: Iterable[str]) -> None:
        """Name the announced subscribers that are to be connected before the first message."""
        self._expected = {_READER + reader.encode() for reader in readers}

    @property
    def complete(self) -> bool:
        """Whether all that were expected were connected when `welcome` was last called."""
        return not self._expected

    def welcome(self) -> None:
        """Send the greeting, or the last message, to those who came since or missed it; call it now and then."""
        self._look()
        late = monotonic() >= self._repeat
        for _ in range(_CHANGES):  # more wait for the next turn: a flood stops nothing
            try:
                change = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                break
            if change[1:].startswith(_READER):
                self._expected.discard(change[1:])
            elif change[1:] not in self._openings:
                self._drop("subscription", "readers subscribe to everything, or to one kind")
            elif change.startswith(b"\x01"):
                late = True
                self._wanted.add(change[1:])
            else:  # the last one who wanted this has left
                self._wanted.discard(change[1:])
        if late and self._last is not None:
            self._repeat = float("inf")
            self._socket.send(self._last, copy=False)


class Subscriber(_Socket):
    """Receives what a channel's publishers send from now on, and where the newest counts their last.

    Parameters
    ----------
    only : the one kind of message to receive; all where None
    every : take also those that are not the newest, as far as they come
    reader : name by which it announced that it waits, see `catstream.wire.announced`
    """

    def __init__(
        self, channel: str, endpoint: Endpoint, only: type | None = None, *, every: bool = False, reader: str = ""
    ) -> None:
        row = CHANNELS[channel]
        super().__init__(zmq.SUB, channel, endpoint, depth=row.depth if row.keeps == "every" else 16)
        if row.keeps == "newest" and len(row.senders) == 1 and not every:
            self._socket.conflate = True
        self._socket.subscribe(b"" if only is None else opening(only))  # the publisher sends nothing else
        if reader:  # it comes in behind what is wanted: topics are sent in order, the empty one first
            self._socket.subscribe(_READER + reader.encode())
        self._connect()

    def pending(self) -> bool:
        """Whether a message is here."""
        return self._wait(0)

    def receive(self, seconds: float) -> Any:
        """The next message, or None where none came in time."""
        if not self._wait(seconds):
            return None
        return self._decode(self._socket.recv(copy=False).buffer, *self.channel.messages)

    def waiting(self) -> list[Any]:
        """All messages that are here already, oldest first."""
        messages = []
        while (message := self.receive(0)) is not None:
            messages.append(message)
        return messages


class Requester(_Socket):
    """Sends commands, one at a time, and waits for the answer to each."""

    def __init__(self, channel: str, endpoint: Endpoint) -> None:
        super().__init__(zmq.DEALER, channel, endpoint, depth=_COMMANDS)
        self._socket.linger = 0  # a command that nobody took is given up
        self._socket.immediate = True
        self._connect()

    def ask(self, command: Command, seconds: float) -> Answer | None:
        """The answer to a command, asked again until it comes; None where none came in time."""
        data, deadline = encode(command), monotonic() + seconds
        while (left := deadline - monotonic()) > 0:
            with contextlib.suppress(zmq.Again):  # nobody there yet
                self._socket.send(data, zmq.NOBLOCK)
            until = monotonic() + min(left, _PATIENCE)
            while (left := until - monotonic()) > 0:
                answer = self._decode(self._socket.recv(), Answer) if self._wait(left) else None
                if answer is not None and answer.id == command.id:  # not a late one to the command before
                    return answer
        return None


class Responder(_Socket):
    """Hears commands and answers them, whoever sends them; it binds."""

    def __init__(self, channel: str, endpoint: Endpoint) -> None:
        super().__init__(zmq.ROUTER, channel, endpoint, depth=_COMMANDS)
        self._asking: dict[str, bytes] = {}  # who asked last, by the command that was not answered yet
        self._answers: dict[str, bytes] = {}  # the last ones, by their command
        self._bind()

    def waiting(self) -> list[Command]:
        """Commands that came since, oldest first; each is to be answered. One that comes again is not among them."""
        commands = []
        for _ in range(_COMMANDS):  # more wait for the next turn: a flood stops nothing
            if not self._wait(0):
                break
            peer, data = self._from_peer()
            command = self._decode(data, Command) if data is not None else None
            if command is None:
                continue
            if (answer := self._answers.get(command.id)) is not None:
                self._send(peer, answer)
            elif command.id in self._asking or len(self._asking) < _COMMANDS:
                if command.id not in self._asking:
                    commands.append(command)
                self._asking[command.id] = peer
        return commands

    def answer(self, answer: Answer) -> None:
        """Answer a command, now and whenever it comes again."""
        self._answers[answer.id] = data = encode(answer)
        if len(self._answers) > _COMMANDS:
            del self._answers[next(iter(self._answers))]
        if (peer := self._asking.pop(answer.id, None)) is not None:
            self._send(peer, data)

    def _send(self, peer: bytes, data: bytes) -> None:
        with contextlib.suppress(zmq.Again):  # one that does not listen asks again
            self._socket.send_multipart([peer, data], zmq.NOBLOCK)

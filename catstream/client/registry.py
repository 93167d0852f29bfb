"""The registry of a fleet: which streams there are, and where each of them runs.

The controller of the fleet serves the registry, and knows the state of all streams. A client needs keys with the role
"watch", or none on this machine. It gets the endpoint and the public key of a stream's pipeline, and connects with its
own keys. No secret is transmitted.

The address of a fleet is HOST:PORT of its registry, or the name of a fleet of this user on this machine; it is empty
for the only one. The address of a stream is `fleet://FLEET/STREAM`, or `fleet://STREAM` in the only fleet.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from time import monotonic
from uuid import uuid4

import msgspec

from catstream.base.names import UNNAMED
from catstream.errors import ServiceError, SilenceError
from catstream.messages.kinds import End, Features, FleetStatus, Listing, Question, StreamStatus, Track
from catstream.wire.channels import REGISTRY
from catstream.wire.commands import Requester, Responder
from catstream.wire.endpoint import Endpoint, Place, find, fleets, private_folder, reserve_endpoint
from catstream.wire.keys import Keys

#: Port at which the registry of a cluster listens by default.
REGISTRY_PORT = 5690

_ANSWER_SECONDS = 5.0  # limit for an answer, by default
_QUIET_SECONDS = 1.0  # without a message of a stream, after which the registry is asked where it runs; then repeated
_PREFIX = "fleet://"


class Registry(AbstractContextManager["Registry"]):
    """Asks the controller of a fleet for its streams and nodes; SilenceError without an answer within the time limit.

    `fleet` is HOST:PORT, the name of a fleet of this user, or empty for the only one; `keys` is the folder of the keys
    of this client, if the fleet requires keys.
    """

    def __init__(self, fleet: str = "", keys: str = "", *, timeout: float = _ANSWER_SECONDS) -> None:
        self.timeout = timeout
        own = Keys.load(keys) if keys else None
        self._name, self._endpoint = _remote(fleet, own) if ":" in fleet else _local(fleet, own)
        self._requester = Requester[Question, Listing](REGISTRY, self._endpoint)
        self._question = ""  # id of the last one that was sent by `request`

    def streams(self, only: str = "") -> FleetStatus:
        """The state of all streams and nodes, or that of one stream."""
        answer = self._requester.ask(Question(uuid4().hex, only), self.timeout)
        if answer is None:
            raise SilenceError(
                f"no answer from the fleet {self._name} at {self._endpoint} within {self.timeout:g} s: is its "
                "controller running there?"
            )
        return _status(answer)

    def stream(self, stream: str) -> StreamStatus:
        """The state of one stream; ServiceError if the fleet has no such stream."""
        found = self.streams(stream)
        if stream not in found.streams:
            names = ", ".join(self.streams().streams) or "none"
            raise ServiceError(f"the fleet {found.name} has no stream {stream!r}: its streams are {names}")
        return found.streams[stream]

    def endpoint_of(self, status: StreamStatus) -> Endpoint | None:
        """The endpoint of the pipeline of a stream in this state, with the keys to connect; None if it has none."""
        if not status.endpoint:
            return None
        keys = self._endpoint.keys
        if status.server and keys is None:
            raise ServiceError(
                f"the stream {status.name} requires authentication: pass a folder of keys that its fleet allows "
                "(--keys DIR, see catstream keys)"
            )
        known = keys.for_server(status.server) if status.server and keys is not None else ""
        return replace(Endpoint.parse(status.endpoint, known), source=status.source)

    def request(self, stream: str) -> None:
        """Ask for one stream without waiting; `receive` returns the answer. A new request replaces the last one."""
        self._question = uuid4().hex
        self._requester.send(Question(self._question, stream))

    def receive(self) -> FleetStatus | None:
        """The answer to `request` if it has arrived."""
        answer = self._requester.receive(self._question, 0)
        return None if answer is None else _status(answer)

    def close(self) -> None:
        self._requester.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _remote(fleet: str, keys: Keys | None) -> tuple[str, Endpoint]:
    """Address and endpoint of a registry."""
    if keys is None and not fleet.startswith(("127.", "[::1]:", "localhost:")):
        raise ServiceError(
            f"the fleet at {fleet} requires authentication: make keys on its head (catstream keys allow FOLDER/keys "
            "NAME --output DIR), and pass them (--keys DIR)"
        )
    return fleet, Endpoint.parse(f"tcp://{fleet}", keys or "")


def _local(fleet: str, keys: Keys | None) -> tuple[str, Endpoint]:
    """Name and endpoint of a fleet of this user."""
    known = fleets()
    names = ", ".join(sorted(known))
    if not fleet and len(known) > 1:
        raise ServiceError(
            f"{len(known)} fleets are running: say which (--fleet NAME, or fleet://NAME/STREAM): {names}"
        )
    fleet = fleet or names
    if fleet not in known:
        raise ServiceError(
            f"{f'no fleet {fleet!r} of yours' if fleet else 'no fleet of yours'} is running: start it (catstream fleet "
            f"up), wait if it starts, or give HOST:PORT of one{f'; there is {names}' if names else ''}"
        )
    return fleet, known[fleet] if keys is None else replace(known[fleet], keys=keys)


def _status(answer: Listing) -> FleetStatus:
    try:
        return msgspec.json.decode(answer.fleet, type=FleetStatus)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ServiceError(f"the registry has sent no state of a fleet ({error}): run the same catstream") from None


class FollowedStream:
    """Follows a stream of a fleet from one pipeline to the next, without waiting.

    While nothing arrives from the stream's pipeline, the registry is asked once a second where the stream runs. If the
    registry does not answer, the last answer holds. The end of a pipeline is the end of the stream only if the registry
    says so: a stream that moves is stopped on one node, and continues on another one.

    registry  of the fleet; it is closed with this object
    place     the endpoint of its pipeline; if it runs nowhere now, of the last one; None if there was none
    status    its newest state
    end       the reason why the stream has ended; None while it continues
    """

    def __init__(self, registry: Registry, stream: str) -> None:
        self._stream, self._registry = stream, registry
        self._pipeline_end: End | None = None
        self._frames: dict[str, int] = {}  # the newest frame of each object
        self.end: End | None = None
        self.place: Endpoint | None = None
        self.status = self._at_place = StreamStatus(stream, "starting")  # newest state; state at the start of `place`
        try:
            self._keep(registry.stream(stream))
        except ServiceError:
            registry.close()
            raise
        self._next_question = monotonic() + _QUIET_SECONDS

    def take(self, message: object) -> bool:
        """Note a message from the pipeline; returns False if it is of a frame that the stream has repeated.

        The registry is not asked while there are any.
        """
        self._next_question = monotonic() + _QUIET_SECONDS
        if isinstance(message, Track | Features):
            name = message.object if isinstance(message, Track) else UNNAMED
            if message.frame <= self._frames.get(name, -1):
                return False
            self._frames[name] = message.frame
        return True

    def pipeline_ended(self, end: End) -> None:
        """Report the end of the pipeline: the registry is asked at once whether it is that of the stream."""
        self._pipeline_end, self._next_question = self._pipeline_end or end, monotonic()

    def update(self) -> bool:
        """Ask if it is time to, and take the answer if it has arrived; returns whether `place` has another pipeline."""
        now = monotonic()
        if now >= self._next_question:
            self._registry.request(self._stream)
            self._next_question = now + _QUIET_SECONDS
        if (answer := self._registry.receive()) is None:
            return False
        if self._stream not in answer.streams:
            gone = f"the stream {self._stream} was removed from the fleet {answer.name}, or the fleet is down"
            self.end = End(0, gone)
            return False
        return self._keep(answer.streams[self._stream])

    def ask(self, seconds: float) -> None:
        """Ask the registry now, and wait for the answer; the last one holds if none arrives in time."""
        self._registry.timeout = seconds
        with contextlib.suppress(SilenceError):
            self._keep(self._registry.stream(self._stream))

    @property
    def endpoint(self) -> Endpoint:
        """The endpoint of its pipeline, as the registry said it last; ServiceError if it runs nowhere."""
        if self.place is None or not self.status.endpoint:
            raise ServiceError(f"the stream {self._stream} runs nowhere, {described(self.status)}")
        return self.place

    def close(self) -> None:
        self._registry.close()

    def _keep(self, status: StreamStatus) -> bool:
        """Keep what the registry says, and end if the stream has ended; returns whether it has another pipeline."""
        before, self.status = self._at_place, status
        moved = bool(status.endpoint) and (
            (status.endpoint, status.server, status.token) != (before.endpoint, before.server, before.token)
        )
        if moved:
            # A live stream uses the numbers of lost frames again, and another source counts from 0.
            if status.live or status.source != before.source:
                self._frames.clear()
            self.place, self._at_place, self._pipeline_end = self._registry.endpoint_of(status), status, None
        if status.state == "ended":
            self.end = self._pipeline_end or End(0, f"the stream {self._stream} has ended")
        return moved


class RegistryServer(AbstractContextManager["RegistryServer"]):
    """Answers the questions of clients about the streams and nodes of a fleet.

    It listens at tcp://HOST:PORT with the keys of a folder, or in a folder of Unix sockets; if that is empty, in a new
    one. Other processes of this user find it by the fleet's name.
    """

    def __init__(self, listen: str, keys: str, status: Callable[[], FleetStatus]) -> None:
        self._status = status
        with ExitStack() as stack:
            folder = stack.enter_context(private_folder())
            self.endpoint = stack.enter_context(reserve_endpoint(listen, folder, keys, fleet=status().name))
            self._responder = stack.enter_context(Responder[Question, Listing](REGISTRY, self.endpoint))
            self._stack = stack.pop_all()

    def turn(self, seconds: float = 0.0) -> int:
        """Answer all questions that have arrived within some seconds, and return their number."""
        questions = self._responder.receive_all(seconds)
        status = self._status() if questions else None
        for question in questions:
            found = status
            if status is not None and (name := question.stream):
                known = {name: status.streams[name]} if name in status.streams else {}
                found = replace(status, streams=known, nodes={})
            self._responder.answer(Listing(question.id, msgspec.json.encode(found)))
        return len(questions)

    def close(self) -> None:
        self._stack.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def address_of(fleet: str, stream: str) -> str:
    """The address of a stream of a fleet: fleet://head:5690/cam-7, or fleet://cam-7 in the only fleet."""
    return f"{_PREFIX}{fleet.removeprefix(_PREFIX).rstrip('/')}/{stream}".replace("///", "//")


def fleet_and_stream(endpoint: Place) -> tuple[str, str] | None:
    """The fleet and the stream of an address, None if it is no address of a stream of a fleet."""
    if not (text := str(endpoint)).startswith(_PREFIX):
        return None
    fleet, _, stream = text.removeprefix(_PREFIX).rpartition("/")
    if not stream or "/" in fleet or (":" in stream and not fleet):
        raise ServiceError(
            f"the address of a stream is fleet://STREAM, fleet://FLEET/STREAM or fleet://HOST:PORT/STREAM, got {text!r}"
        )
    return fleet, stream


def follow(endpoint: Place, keys: str = "") -> FollowedStream | None:
    """The stream of a fleet that has this address; None if it is no address of a stream."""
    if (address := fleet_and_stream(endpoint)) is None:
        return None
    fleet, stream = address
    return FollowedStream(Registry(fleet, keys), stream)


def described(status: StreamStatus) -> str:
    """The state of a stream, for a message to the user."""
    return f"its state is {status.state}{': ' if status.trouble else ''}{status.trouble}"


def locate(endpoint: Place, keys: str = "") -> Endpoint:
    """The endpoint of a running pipeline, as `find` returns it; for the address of a stream, that of its pipeline."""
    if (stream := follow(endpoint, keys)) is None:
        return find(endpoint, keys)
    with contextlib.closing(stream):
        return stream.endpoint

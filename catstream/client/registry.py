"""The registry of a fleet: which streams there are, and where each of them runs.

    from catstream.client.registry import Registry

    with Registry("head.example.org:5690", keys="my-keys") as registry:
        for stream in registry.streams().streams.values():
            print(stream.name, stream.state, stream.node)

The controller of the fleet serves the registry (`RegistryServer`), and knows the state of all streams. A client needs
keys with the role "watch", or none if the fleet runs on this machine for this user alone. It gets the endpoint and the
public key of a stream's pipeline, and connects with its own keys. No secret is transmitted.

The address of a fleet is HOST:PORT of its registry, or the name of a fleet of this user on this machine; it is empty
for the only one. The address of a stream is `fleet://FLEET/STREAM`, or `fleet://STREAM` in the only fleet.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from time import monotonic
from typing import Self, TypeVar
from uuid import uuid4

from catstream.errors import ProtocolError, ServiceError, SilenceError
from catstream.messages.kinds import End, Features, FleetStatus, Listing, NodeStatus, Question, StreamStatus, Track
from catstream.messages.names import UNNAMED
from catstream.messages.schema import LONGEST_LIST
from catstream.wire.channels import REGISTRY
from catstream.wire.commands import Requester, Responder
from catstream.wire.endpoint import Endpoint, Place, find, fleets, meeting_place, private_folder
from catstream.wire.keys import Keys

ANSWER_SECONDS = 5.0  #: limit for the answer of a registry, by default
CONTROLLER_SECONDS = 0.5  #: without an answer, after which the endpoint of a fleet on this machine is read again
QUIET_SECONDS = 1.0  #: without a message, after which the registry is asked where a stream runs; then repeated

_log = logging.getLogger(__name__)

Status = TypeVar("Status", StreamStatus, NodeStatus)

#: Port at which the registry of a cluster listens by default.
REGISTRY_PORT = 5690

_PREFIX = "fleet://"
_LONGEST_TROUBLE = 1000  # characters


class Registry:
    """Asks the controller of a fleet for its streams and nodes.

    Parameters
    ----------
    fleet : str
        Address of the fleet: HOST:PORT, the name of a fleet of this user, or empty for the only one.
    keys : str
        Folder of the keys of this client, if the fleet requires keys.
    timeout : float
        Seconds to wait for an answer.

    Raises
    ------
    ServiceError
        If this user has no such fleet, or the keys cannot be read; from each question, if the fleet rejects the keys.
    SilenceError
        From each question, if no answer arrives in time.
    """

    def __init__(self, fleet: str = "", keys: str = "", *, timeout: float = ANSWER_SECONDS) -> None:
        self.timeout = timeout
        self._keys = Keys.load(keys) if keys else None
        self._is_remote = ":" in fleet
        self._name, self._endpoint = (fleet, self._remote(fleet)) if self._is_remote else self._local(fleet)
        self._requester = Requester[Question, Listing](REGISTRY, self._endpoint)
        self._question = ""  # id of the last one that was sent by `request`

    def streams(self) -> FleetStatus:
        """The state of all streams and nodes."""
        listing = self._ask(Question(uuid4().hex))
        status = FleetStatus(listing.fleet, listing.time, dict(listing.streams), dict(listing.nodes))
        while listing.more and (names := [*listing.streams, *listing.nodes]):
            listing = self._ask(Question(uuid4().hex, after=max(names)))
            status.streams.update(listing.streams)
            status.nodes.update(listing.nodes)
        return status

    def stream(self, stream: str) -> StreamStatus:
        """The state of one stream.

        Raises
        ------
        ServiceError
            If the fleet has no such stream.
        """
        listing = self._ask(Question(uuid4().hex, stream))
        if stream not in listing.streams:
            names = ", ".join(self.streams().streams) or "none"
            raise ServiceError(f"the fleet {listing.fleet} has no stream {stream!r}: its streams are {names}")
        return listing.streams[stream]

    def endpoint_of(self, status: StreamStatus) -> Endpoint | None:
        """The endpoint of the pipeline of a stream in this state, with the keys to connect with; None if it has none.

        Raises
        ------
        ServiceError
            If its pipeline requires keys and there are none.
        """
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
        self._follow_controller()
        self._requester.send(Question(self._question, stream))

    def receive(self) -> Listing | None:
        """The answer to `request` if it has arrived."""
        return self._requester.receive(self._question, 0)

    def fileno(self) -> int:
        """Readable if an answer may have arrived."""
        return self._requester.fileno()

    def close(self) -> None:
        """Disconnect."""
        self._requester.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, question: Question) -> Listing:
        deadline = monotonic() + self.timeout
        while (left := deadline - monotonic()) > 0:
            self._follow_controller()
            if (answer := self._requester.ask(question, min(left, CONTROLLER_SECONDS))) is not None:
                return answer
        raise SilenceError(
            f"no answer from the fleet {self._name} at {self._endpoint} within {self.timeout:g} s: is its controller "
            "running there?"
        )

    def _follow_controller(self) -> None:
        """Connect again if the controller of a fleet on this machine was started again, at another endpoint."""
        found = None if self._is_remote else fleets().get(self._name)
        if found is not None and str(found) != str(self._endpoint):
            self._requester.close()
            self._endpoint = self._with_keys(found)
            self._requester = Requester[Question, Listing](REGISTRY, self._endpoint)

    def _remote(self, fleet: str) -> Endpoint:
        if self._keys is None and not fleet.startswith(("127.", "[::1]:")):
            raise ServiceError(
                f"the fleet at {fleet} requires authentication: make keys on its head (catstream keys allow "
                "FOLDER/keys NAME --output DIR), and pass them (--keys DIR)"
            )
        return Endpoint.parse(f"tcp://{fleet}", self._keys or "")

    def _local(self, fleet: str) -> tuple[str, Endpoint]:
        """Name and endpoint of a fleet of this user."""
        known = fleets()
        if not fleet and len(known) == 1:
            fleet = next(iter(known))
        if fleet in known:
            return fleet, self._with_keys(known[fleet])
        if fleet or not known:
            which = f"no fleet {fleet!r} of yours" if fleet else "no fleet of yours"
            listed = f"; there is {', '.join(sorted(known))}" if known else ""
            raise ServiceError(
                f"{which} is running: start it (catstream fleet up), wait if it starts or if a node has just died, or "
                f"give HOST:PORT of one{listed}"
            )
        names = ", ".join(sorted(known))
        raise ServiceError(
            f"{len(known)} fleets are running: say which (--fleet NAME, or fleet://NAME/STREAM): {names}"
        )

    def _with_keys(self, endpoint: Endpoint) -> Endpoint:
        return endpoint if self._keys is None else replace(endpoint, keys=self._keys)


class FollowedStream:
    """Follows a stream of a fleet from one pipeline to the next, without waiting.

    While nothing arrives from the stream's pipeline, the registry is asked once a second where the stream runs. If the
    registry does not answer, the last answer holds. The end of a pipeline is the end of the stream only if the registry
    says so: a stream that moves is stopped on one node, and continues on another one.

    Parameters
    ----------
    registry : Registry
        The registry of the fleet; it is closed with this object.
    stream : str
        Name of the stream.

    Attributes
    ----------
    place : Endpoint or None
        The endpoint of its pipeline; if it runs nowhere now, of the last one; None if there was none.
    status : StreamStatus
        Its newest state.
    end : End or None
        The reason why the stream has ended; None while it continues.

    Raises
    ------
    ServiceError
        If the fleet has no such stream, or does not accept the keys.
    SilenceError
        If the controller does not answer at first.
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
        self._next_question = monotonic() + QUIET_SECONDS

    def take(self, message: object) -> bool:
        """Note a message from the pipeline; returns False if it is of a frame that the stream has repeated.

        The registry is not asked while there are any.
        """
        self._next_question = monotonic() + QUIET_SECONDS
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
            self._next_question = now + QUIET_SECONDS
        if (listing := self._registry.receive()) is None:
            return False
        if self._stream not in listing.streams:
            self.end = End(0, f"the stream {self._stream} was removed from the fleet {listing.fleet}")
            return False
        return self._keep(listing.streams[self._stream])

    def ask(self, seconds: float) -> None:
        """Ask the registry now, and wait for the answer; the last one holds if none arrives in time.

        Raises
        ------
        ServiceError
            If the fleet has no such stream any more.
        """
        self._registry.timeout = seconds
        with contextlib.suppress(SilenceError):
            self._keep(self._registry.stream(self._stream))

    @property
    def endpoint(self) -> Endpoint:
        """The endpoint of its pipeline, as the registry said it last.

        Raises
        ------
        ServiceError
            If it runs nowhere.
        """
        if self.place is None or not self.status.endpoint:
            raise ServiceError(f"the stream {self._stream} runs nowhere, {described(self.status)}")
        return self.place

    def fileno(self) -> int:
        """Readable if an answer may have arrived."""
        return self._registry.fileno()

    def close(self) -> None:
        """Disconnect from the registry."""
        self._registry.close()

    def _keep(self, status: StreamStatus) -> bool:
        """Keep what the registry says, and end if the stream has ended; returns whether it has another pipeline."""
        before, self.status = self._at_place, status
        moved = bool(status.endpoint) and (
            (status.endpoint, status.server, status.token) != (before.endpoint, before.server, before.token)
        )
        if moved:
            if (status.source, status.began) != (before.source, before.began):  # its frames count from 0 again
                self._frames.clear()
            self.place, self._at_place, self._pipeline_end = self._registry.endpoint_of(status), status, None
        if status.state == "ended":
            self.end = self._pipeline_end or End(0, f"the stream {self._stream} has ended")
        return moved


class RegistryServer:
    """Answers the questions of clients about the streams and nodes of a fleet.

    Parameters
    ----------
    listen : str
        tcp://HOST:PORT, of which this port listens; empty for a Unix socket in a private folder.
    keys : str
        Folder of the fleet's keys, required if other machines can reach the host; empty for none.
    status : callable
        Returns the present state of the fleet; it is called once here, for the fleet's name, and then by `turn`.

    Attributes
    ----------
    endpoint : Endpoint
        The endpoint. While the server is open, other processes of this user find it by the fleet's name.

    Raises
    ------
    ServiceError
        If the address is not valid or in use, or the keys cannot be read.
    """

    def __init__(self, listen: str, keys: str, status: Callable[[], FleetStatus]) -> None:
        self._status = status
        with ExitStack() as stack:
            folder = stack.enter_context(private_folder())
            self.endpoint = stack.enter_context(meeting_place(listen, folder, keys, fleet=status().name))
            self._responder = stack.enter_context(Responder[Question, Listing](REGISTRY, self.endpoint))
            self._stack = stack.pop_all()

    def turn(self, seconds: float = 0.0) -> int:
        """Answer all questions that have arrived, and return their number.

        Parameters
        ----------
        seconds : time to wait for the first question
        """
        questions = self._responder.receive_all(seconds)
        if questions:
            status = self._status()
            for question in questions:
                try:
                    self._responder.answer(_listing(question, status))
                except ProtocolError as error:  # other questions may be about streams whose state is valid
                    _log.error("A question was not answered: %s", error)
        return len(questions)

    def close(self) -> None:
        """Stop listening."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _listing(question: Question, status: FleetStatus) -> Listing:
    """The answer to a question: the stream that it asks for, or as much as one message holds."""
    if question.stream:
        names, more = [question.stream], False
    else:
        left = sorted(name for name in status.streams.keys() | status.nodes.keys() if name > question.after)
        names, more = left[:LONGEST_LIST], len(left) > LONGEST_LIST
    streams = {name: _shortened(status.streams[name]) for name in names if name in status.streams}
    nodes = {name: _shortened(status.nodes[name]) for name in names if name in status.nodes and not question.stream}
    return Listing(question.id, status.name, status.time, streams, nodes, more)


def _shortened(status: Status) -> Status:
    """A status whose description of a problem is short enough for a message."""
    if len(status.trouble) <= _LONGEST_TROUBLE:
        return status
    return replace(status, trouble=f"{status.trouble[:_LONGEST_TROUBLE]}...")


def address_of(fleet: str, stream: str) -> str:
    """The address of a stream of a fleet.

    >>> address_of("head:5690", "cam-7"), address_of("", "cam-7")
    ('fleet://head:5690/cam-7', 'fleet://cam-7')
    """
    return f"{_PREFIX}{fleet.removeprefix(_PREFIX).rstrip('/')}/{stream}" if fleet else f"{_PREFIX}{stream}"


def fleet_and_stream(endpoint: Place) -> tuple[str, str] | None:
    """The fleet and the stream of an address, None if it is no address of a stream of a fleet.

    Raises
    ------
    ServiceError
        If the address has no name of a stream.

    >>> fleet_and_stream("fleet://head:5690/cam-7"), fleet_and_stream("fleet://cam-7"), fleet_and_stream("run")
    (('head:5690', 'cam-7'), ('', 'cam-7'), None)
    """
    if not (text := str(endpoint)).startswith(_PREFIX):
        return None
    fleet, _, stream = text.removeprefix(_PREFIX).rpartition("/")
    if not stream or "/" in fleet or (":" in stream and not fleet):
        raise ServiceError(
            f"the address of a stream is fleet://STREAM, fleet://FLEET/STREAM or fleet://HOST:PORT/STREAM, got {text!r}"
        )
    return fleet, stream


def follow(endpoint: Place, keys: str = "") -> FollowedStream | None:
    """The stream of a fleet that has this address; None if it is no address of a stream.

    Raises
    ------
    ServiceError, SilenceError
        As `Registry` and `FollowedStream`.
    """
    if (address := fleet_and_stream(endpoint)) is None:
        return None
    fleet, stream = address
    return FollowedStream(Registry(fleet, keys), stream)


def described(status: StreamStatus) -> str:
    """The state of a stream, for a message to the user.

    >>> described(StreamStatus("cam-7", "unplaced", trouble="cam-7 needs a node with site=north"))
    'its state is unplaced: cam-7 needs a node with site=north'
    """
    return f"its state is {status.state}{': ' if status.trouble else ''}{status.trouble}"


def locate(endpoint: Place, keys: str = "") -> Endpoint:
    """The endpoint of a running pipeline, as `find` returns it; for the address of a stream, that of its pipeline now.

    Raises
    ------
    ServiceError
        If there is none, or more than one; if the fleet has no such stream, or it does not run.
    SilenceError
        If the controller of the fleet does not answer.
    """
    if (stream := follow(endpoint, keys)) is None:
        return find(endpoint, keys)
    with contextlib.closing(stream):
        return stream.endpoint

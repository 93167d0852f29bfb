"""The channels between the processes: their messages, their two ends, and their behaviour with slow readers.

    all-features   the training rows of each frame; every message is delivered exactly once: it is acknowledged, and
               retransmitted to a restarted receiver
    samples    only the newest of each object counts; a late joiner gets the last ones at once
    models     as samples
    tracks     every message, one for each object and frame, to any number of subscribers; a slow one misses some, and
               sees by `frame` how many
    results    the tracks again, one message a frame, for the program that started the pipeline, its owner
    health     the newest of each process
    previews   small pictures of the newest frame, made only for a subscriber
    control    commands and their answers; a command without an answer is sent again, and executed once
    saved-models   the newest coreset trees of each object as a file, made only for a subscriber
    features   a copy of the training rows, sent only if there is a subscriber

The controller of a fleet has an endpoint of its own, with one channel:

    registry   questions about the streams of the fleet, and their answers

The one receiver of a channel binds its address; if there are many, its sender does. The rest connect, in any order.
`catstream.wire.endpoint` says what the addresses are. If the pipeline has keys (`catstream.wire.keys`), a peer that
connects needs the role in the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from catstream.wire.messages import (
    Answer,
    Command,
    End,
    Features,
    Health,
    Listing,
    Model,
    ModelFile,
    Preview,
    Question,
    Sample,
    Track,
    Tracks,
)

#: The permissions of a client: each role includes those before it.
Role = Literal["watch", "control", "pipeline"]

#: The port of the first channel, by default.
PORT = 5700

Message = TypeVar("Message", covariant=True)


@dataclass(frozen=True, slots=True)
class Channel(Generic[Message]):
    """One row of the table.

    name             the plural of the messages
    messages         kinds of message that it carries
    senders          processes that send, or "anyone"
    receiver         the one process that every message is for, or None: any number of subscribers
    keeps            "every" message, or the "newest"
    port             offset from the first port; each further sender takes the next one
    megabytes        size of the largest message
    role             role that a peer which connects needs at least
    high_water_mark  how many messages a subscriber may lag behind before it misses some
    """

    name: str
    messages: tuple[type[Message], ...]
    senders: tuple[str, ...]
    receiver: str | None
    keeps: Literal["every", "newest"]
    port: int
    megabytes: int
    role: Role = "pipeline"
    high_water_mark: int = 1000

    @property
    def by_object(self) -> bool:
        """True if each message is about one object."""
        return "object" in self.messages[0].__annotations__

    @property
    def limit(self) -> int:
        """Bytes of the largest message."""
        return self.megabytes << 20


_ALL = ("detector", "compressor", "trainer")
_FEATURES = 512  # MiB: an object takes 4.3 MB in its first frame, there are at most 64, and their saved models

ALL_FEATURES: Channel[Features | End] = Channel(
    "all-features", (Features, End), ("detector",), "compressor", "every", port=0, megabytes=_FEATURES
)
SAMPLES: Channel[Sample | End] = Channel(
    "samples", (Sample, End), ("compressor",), None, "newest", 1, 512, "watch", high_water_mark=16
)
MODELS: Channel[Model] = Channel("models", (Model,), ("trainer",), None, "newest", 2, 1, "watch", high_water_mark=256)
TRACKS: Channel[Track | End] = Channel("tracks", (Track, End), ("detector",), None, "every", 3, 1, "watch")
RESULTS: Channel[Tracks | End] = Channel("results", (Tracks, End), ("detector",), "owner", "every", port=4, megabytes=1)
HEALTH: Channel[Health] = Channel("health", (Health,), _ALL, None, "newest", 5, 1, "watch", high_water_mark=16)
PREVIEWS: Channel[Preview] = Channel(
    "previews", (Preview,), ("detector",), None, "newest", 8, 1, "watch", high_water_mark=8
)
CONTROL: Channel[Command | Answer] = Channel(
    "control", (Command, Answer), ("anyone",), "detector", "every", port=9, megabytes=64, role="control"
)
FEATURES: Channel[Features | End] = Channel(
    "features", (Features, End), ("detector",), None, "every", 10, _FEATURES, "watch", high_water_mark=64
)
SAVED_MODELS: Channel[ModelFile] = Channel(
    "saved-models", (ModelFile,), ("compressor",), None, "newest", 11, 512, role="watch", high_water_mark=2
)

#: THE TABLE, by name.
CHANNELS: dict[str, Channel[object]] = {
    channel.name: channel
    for channel in (
        ALL_FEATURES,
        SAMPLES,
        MODELS,
        TRACKS,
        RESULTS,
        HEALTH,
        PREVIEWS,
        CONTROL,
        FEATURES,
        SAVED_MODELS,
    )
}

#: The channels that a client may subscribe to, by name (`catstream.subscribe`, `catstream watch`).
PUBLIC: dict[str, Channel[object]] = {
    name: channel for name, channel in CHANNELS.items() if channel.role == "watch" and channel is not SAVED_MODELS
}

#: The only channel of the controller of a fleet, which is no process of a pipeline and has an endpoint of its own.
REGISTRY: Channel[Question | Listing] = Channel(
    "registry", (Question, Listing), ("anyone",), "controller", "every", port=0, megabytes=16, role="watch"
)

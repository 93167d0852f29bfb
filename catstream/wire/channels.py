"""The channels between the processes: their messages, endpoints, and behaviour with slow receivers.

    all-features   the training rows of each frame, acknowledged, retransmitted, and delivered exactly once
    samples        the newest of each object; late joiners receive the last ones at once
    models         the newest of each object; late joiners receive the last ones at once
    tracks         every message, one for each object and frame, to any number of subscribers; a slow subscriber misses
                   messages, which it detects by `frame`
    results        all tracks of a frame in one message, for the program that started the pipeline (its owner)
    health         the newest of each process
    previews       small pictures of the newest frame, made only for subscribers
    control        commands and their answers; a command is repeated until it is answered, and executed once
    saved-models   the newest coreset trees of each object as a file, made only for subscribers
    features       a copy of the training rows, sent only to subscribers

The controller of a fleet has its own endpoint, with one channel:

    registry       questions about the streams of the fleet, and their answers

The only receiver of a channel binds its address; with several receivers, the sender binds. The other side connects, in
any order. `catstream.wire.endpoint` defines the addresses. If the pipeline has keys (`catstream.wire.keys`), a
connecting peer needs the role in the table.
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
    receiver         the only receiver, or None for any number of subscribers
    keeps            "every" message, or the "newest"
    port             offset from the first port; further senders use the next ones
    megabytes        size of the largest message
    role             minimum role of a connecting peer
    high_water_mark  number of messages that a subscriber may lag behind before it misses some
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
_FEATURES = 512  # MiB: 4.3 MB in the first frame of each of 64 objects, and their saved models

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

#: All channels of a pipeline, by name.
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

#: The only channel of a fleet's controller, which has its own endpoint.
REGISTRY: Channel[Question | Listing] = Channel(
    "registry", (Question, Listing), ("anyone",), "controller", "every", port=0, megabytes=16, role="watch"
)

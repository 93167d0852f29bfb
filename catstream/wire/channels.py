"""The channels: what flows between the processes, from whom to whom, and what a slow reader does to it.

    features   every message arrives exactly once: acknowledged, and sent again to a restarted receiver
    samples    the newest counts, an older one is stale; who comes late gets the last one at once
    models     as samples
    tracks     every message, to any number of readers; a slow one loses some, and sees by `seq` how many
    results    the tracks once more, acknowledged: for the one process that started the pipeline
    health     the newest of each process
    previews   small pictures of the newest frame; none is made where nobody looks
    control    commands, each answered; who hears no answer asks again, and it is done once
    lessons    the features once more, to any number of readers; nothing is sent where there is none

The receiver of an acknowledged channel binds its address, and so does the sender of any other;
the rest connect, in any order. See `catstream.wire.endpoint` for what the addresses are. Where the
pipeline has keys (`catstream.wire.keys`), who connects must have the role that a channel asks for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from catstream.messages import Answer, Command, End, Features, Health, Model, Preview, Run, Sample, Track

__all__ = ["CHANNELS", "PORT", "Channel", "Role"]

#: What a client may be: each may do what those before it may.
Role = Literal["watch", "steer", "pipeline"]

#: The port of the first channel, by default.
PORT = 5700


@dataclass(frozen=True, slots=True)
class Channel:
    """One row of the table.

    name       the plural of what flows
    messages   kinds that it carries
    senders    processes that send, or "anyone"
    receiver   the one process that every message is for, or None: whoever wants them
    keeps      "every" message, or the "newest"
    port       offset from the first port; each further sender takes the next one
    megabytes  size of the largest message
    role       what who connects must at least be
    depth      where every message counts: how many a slow reader may fall behind before it loses some
    """

    name: str
    messages: tuple[type, ...]
    senders: tuple[str, ...]
    receiver: str | None
    keeps: Literal["every", "newest"]
    port: int
    megabytes: int
    role: Role = "pipeline"
    depth: int = 1000

    @property
    def acknowledged(self) -> bool:
        """Whether each message is repeated until its one receiver has answered it."""
        return self.receiver is not None

    @property
    def limit(self) -> int:
        """Bytes of the largest message."""
        return self.megabytes << 20


_ALL = ("detector", "compressor", "trainer")

#: THE TABLE.
CHANNELS: dict[str, Channel] = {
    channel.name: channel
    for channel in (
        Channel("features", (Features, End), ("detector",), "compressor", "every", port=0, megabytes=64),
        Channel("samples", (Sample, End), ("compressor",), None, "newest", port=1, megabytes=512, role="watch"),
        Channel("models", (Model,), ("trainer",), None, "newest", port=2, megabytes=1, role="watch"),
        Channel("tracks", (Track, End), ("detector",), None, "every", port=3, megabytes=1, role="watch"),
        Channel("results", (Track, End), ("detector",), "owner", "every", port=4, megabytes=1),
        Channel("health", (Health,), _ALL, None, "newest", port=5, megabytes=1, role="watch"),
        Channel("previews", (Preview,), ("detector",), None, "newest", port=8, megabytes=1, role="watch"),
        Channel("control", (Command, Answer), ("anyone",), "detector", "every", port=9, megabytes=1, role="steer"),
        Channel(
            "lessons", (Run, Features, End), ("detector",), None, "every", port=10, megabytes=64, role="watch", depth=64
        ),
    )
}

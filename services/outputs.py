"""The channels that a detector sends on."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Self

from catstream.messages.kinds import End, Features, Tracks
from catstream.services.loop import Process
from catstream.services.previews import Previews
from catstream.services.timing import TURN_SECONDS
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import FEATURES, RESULTS, TRACKS, TRAINING
from catstream.wire.newest import Publisher

#: Sends one of the two streams that are received without a loss.
DataSender = Sender[Features | End] | Sender[Tracks | End]


class Outputs:
    """The sockets that a detector sends on; a context manager.

    Attributes
    ----------
    features : sender of the features to the compressor
    results : sender of the tracks to the owner of the run; None if it has no owner
    senders : both senders by the names of their channels, `features` first; without `results` if it is None
    previews : pictures of frames for subscribers
    """

    def __init__(self, process: Process) -> None:
        window, endpoint = process.settings.run.unstored_frames, process.endpoint
        with ExitStack() as stack:
            self.features = stack.enter_context(Sender(FEATURES, endpoint, window))
            owned = process.job.owned
            self.results = stack.enter_context(Sender(RESULTS, endpoint, window)) if owned else None
            self._tracks = stack.enter_context(Publisher(TRACKS, endpoint))
            self._training = stack.enter_context(Publisher(TRAINING, endpoint))
            self.previews = stack.enter_context(Previews(endpoint))
            self._stack = stack.pop_all()
        self.senders: dict[str, DataSender] = {"features": self.features}
        if self.results is not None:
            self.senders["results"] = self.results

    def poll(self, awaited: str | None = None) -> None:
        """Process acknowledgements; wait a short time for one on the channel `awaited`."""
        for name, sender in self.senders.items():
            sender.poll(TURN_SECONDS if name == awaited else 0)

    def serve_late_joiners(self) -> None:
        """Send the end or the newest preview to new subscribers."""
        self._tracks.serve_late_joiners()
        self._training.serve_late_joiners()
        self.previews.turn()

    def publish(self, tracks: Tracks | End, features: Features | End) -> None:
        """Send the tracks of a frame, one message an object, and its features to all subscribers; or the end."""
        for each in tracks.tracks.values() if isinstance(tracks, Tracks) else (tracks,):
            self._tracks.send(each)
        self._training.send(features)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

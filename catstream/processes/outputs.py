"""The outputs of a detector: tracks and features of each frame, pictures of some, and the end."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from time import monotonic, sleep

from catstream.base.addresses import is_live
from catstream.base.box import Box
from catstream.processes.process import TURN_SECONDS, Process
from catstream.video.frames import Frame, jpeg
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import ALL_FEATURES, FEATURES, PREVIEWS, TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Features, Preview, Tracks
from catstream.wire.newest import Publisher
from catstream.wire.results import ResultsSender

_LOOK_SECONDS = 0.002  # polling interval of the messages that the owner of the run has read
_FEATURES_END_SECONDS = 10.0  # limit for the end to be stored, once the process was asked to end
_RESULTS_END_SECONDS = 0.5  # the same for the owner of the run to receive the end
_PREVIEW_SECONDS = 0.1  # shortest time between two pictures for subscribers
_SIDE = 640  # longest side of a picture, in pixels
_STORED_SECONDS = 5.0  # that a preview's frame is stored, in case a client draws a box in it
_STORED_BYTES = 256 << 20  # of these frames at most


class Outputs(AbstractContextManager["Outputs"]):
    """The sockets that a detector sends on; a context manager.

    Backpressure: `send` blocks while `run.unstored_frames` messages are not stored by the compressor, or not read by
    the owner of the run. Subscribers never block it.

    turn     called repeatedly while it blocks
    replied  called after each reply of the compressor, such as `TrainingLag.reply`
    """

    def __init__(
        self, process: Process, turn: Callable[[], object], replied: Callable[[int, dict[str, int]], object]
    ) -> None:
        self._process, self._turn, endpoint = process, turn, process.endpoint
        with ExitStack() as stack:
            window = process.settings.run.unstored_frames
            self.features = stack.enter_context(Sender(ALL_FEATURES, endpoint, window, replied))
            self._owner = stack.enter_context(ResultsSender(endpoint)) if process.owner is not None else None
            self._tracks = stack.enter_context(Publisher(TRACKS, endpoint))
            self._copies = stack.enter_context(Publisher(FEATURES, endpoint))
            self.previews = stack.enter_context(Previews(endpoint, stores=is_live(process.job.source)))
            self._stack = stack.pop_all()
        self._complete = True  # whether no message was dropped: none may follow it

    def serve_late_joiners(self) -> None:
        """Send the end or the newest preview to new subscribers."""
        self._tracks.serve_late_joiners()
        self._copies.serve_late_joiners()
        self.previews.turn()

    def send(self, tracks: Tracks, features: Features) -> None:
        """Send the tracks to the owner and the features to the compressor once there is room; both to subscribers."""
        self.publish(tracks, features)
        if self._owner is not None:
            self._wait_for_owner(tracks.seq - self._process.settings.run.unstored_frames)
            self._owner.send(tracks)
        self._send_features(features)

    def _wait_for_owner(self, seq: float, seconds: float = 0.0) -> None:
        """Wait until the owner has read message `seq`; after a signal, at most so many seconds."""
        owner, ending = self._process.owner, self._process.ending
        while owner is not None and owner.read < seq and ending.seconds_since_signal < seconds:
            sleep(_LOOK_SECONDS)
            self._turn()

    def _send_features(self, features: Features | End) -> None:
        """Send features once there is room; after a signal, they are dropped without room."""
        while self.features.window.full and not self._process.ending.signalled:
            self.features.poll(TURN_SECONDS)
            self._turn()
        self._complete &= not self.features.window.full
        if self._complete:
            self.features.send(features)

    def publish(self, tracks: Tracks | End, features: Features | End) -> None:
        """Send the tracks of a frame, one message an object, and its features to all subscribers; or the end."""
        for track in tracks.tracks.values() if isinstance(tracks, Tracks) else (tracks,):
            self._tracks.send(track)
        self._copies.send(features)

    def end(self, seq: int, counters: Callable[[], dict[str, float]]) -> End:
        """Send the end after message `seq`: to the compressor, and once that has stored everything, to the owner.

        Returns it, with the `counters` of the source in its totals. There is no time limit unless a signal arrived.
        """
        ending, window = self._process.ending, self.features.window
        self._send_features(End(seq, ending.reason, ending.failed))
        while self._complete and window.acknowledged <= seq and ending.seconds_since_signal <= _FEATURES_END_SECONDS:
            self.features.poll(TURN_SECONDS)
            self._turn()
        totals = {"sent": float(seq), "stored": float(min(window.stored, seq))} | counters()
        totals.pop("lost_seconds", None)  # this one is of the moment
        end = End(seq, ending.reason, ending.failed, totals)
        if self._owner is not None:
            self._owner.send(end)
            self._wait_for_owner(math.inf, _RESULTS_END_SECONDS)
        return end

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class Previews(Publisher[Preview]):
    """Sends the newest frame as a small picture, at most ten a second; none is made if there are no subscribers.

    With `stores`, it stores the frames of the last pictures while there are subscribers.
    """

    def __init__(self, endpoint: Endpoint, *, stores: bool = False) -> None:
        super().__init__(PREVIEWS, endpoint)
        self._waiting: tuple[int, Frame, dict[str, Box]] | None = None
        self._sent_at = 0.0
        self._stores, self._frames = stores, deque[Frame]()

    def show(self, number: int, frame: Frame, boxes: dict[str, Box]) -> None:
        """Send a frame, whose image stays unchanged, unless a newer one arrives before it is due."""
        self._waiting = number, frame, boxes
        self.turn()

    def since(self, time: float) -> list[Frame]:
        """The stored frames from the picture with this time on; empty if it is not stored any more."""
        frames = [frame for frame in self._frames if frame.time >= time]
        return frames if frames and frames[0].time == time else []

    def turn(self) -> None:
        """Send a preview if one is due; call it in every iteration, even without a frame, as subscribers may join."""
        self.serve_late_joiners()
        if not self.has_subscribers:
            self._frames.clear()
        if self._waiting is None or not self.has_subscribers or monotonic() - self._sent_at < _PREVIEW_SECONDS:
            return
        (number, frame, boxes), self._waiting, self._sent_at = self._waiting, None, monotonic()
        height, width = frame.image.shape[:2]
        self.send(Preview(number, frame.time, width, height, boxes, jpeg(frame.image, _SIDE)))
        if self._stores:
            most = max(1, _STORED_BYTES // frame.image.nbytes)
            self._frames.append(frame)
            while self._frames[0].time < frame.time - _STORED_SECONDS or len(self._frames) > most:
                self._frames.popleft()

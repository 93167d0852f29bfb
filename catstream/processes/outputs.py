"""The outputs of a detector: tracks and features of each frame, previews, and the end of the stream."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from time import monotonic, sleep

from catstream.base.addresses import is_live
from catstream.base.box import Box
from catstream.processes.process import POLL_SECONDS, Process
from catstream.video.frames import Frame, jpeg
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import ALL_FEATURES, FEATURES, PREVIEWS, TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Features, Preview, Tracks
from catstream.wire.newest import Publisher
from catstream.wire.results import ResultsSender

_LOOK_SECONDS = 0.002  # polling interval of the consumer's progress
_FEATURES_END_SECONDS = 10.0  # timeout after a signal for the compressor to store the end
_RESULTS_END_SECONDS = 0.5  # timeout after a signal for the consumer to receive the end
_PREVIEW_SECONDS = 0.1  # minimum interval between two previews
_SIDE = 640  # longest side of a preview, in pixels
_STORED_SECONDS = 5.0  # how long a preview's frame is stored, in case a client draws a box in it
_STORED_BYTES = 256 << 20  # maximum size of the stored frames


class Outputs(AbstractContextManager["Outputs"]):
    """The sockets that a detector sends on; a context manager.

    Backpressure: `send` blocks while `run.unstored_frames` messages are not stored by the compressor, or not read by
    the consumer of the results. Subscribers never block it.

    poll     called repeatedly while it blocks
    replied  called after each reply of the compressor, such as `TrainingLag.reply`
    """

    def __init__(
        self, process: Process, poll: Callable[[], object], replied: Callable[[int, dict[str, int]], object]
    ) -> None:
        self._process, self._poll, endpoint = process, poll, process.endpoint
        with ExitStack() as stack:
            window = process.settings.run.unstored_frames
            self.features = stack.enter_context(Sender(ALL_FEATURES, endpoint, window, replied))
            self._results = stack.enter_context(ResultsSender(endpoint)) if process.consumer is not None else None
            self._tracks = stack.enter_context(Publisher(TRACKS, endpoint))
            self._copies = stack.enter_context(Publisher(FEATURES, endpoint))
            self.previews = stack.enter_context(Previews(endpoint, stores=is_live(process.job.source)))
            self._stack = stack.pop_all()
        self._complete = True  # False once a message was dropped: later messages are dropped as well

    def serve_late_joiners(self) -> None:
        """Send the end or the newest preview to new subscribers."""
        self._tracks.serve_late_joiners()
        self._copies.serve_late_joiners()
        self.previews.serve()

    def send(self, tracks: Tracks, features: Features) -> None:
        """Publish a frame, then send its tracks to the consumer and its features to the compressor."""
        self.publish(tracks, features)
        if self._results is not None:
            self._wait_for_consumer(tracks.seq - self._process.settings.run.unstored_frames)
            self._results.send(tracks)
        self._send_features(features)

    def _wait_for_consumer(self, seq: float, seconds: float = 0.0) -> None:
        """Wait until the consumer has read message `seq`; after a signal, at most `seconds`."""
        consumer, ending = self._process.consumer, self._process.ending
        while consumer is not None and consumer.read < seq and ending.seconds_since_signal < seconds:
            sleep(_LOOK_SECONDS)
            self._poll()

    def _send_features(self, features: Features | End) -> None:
        """Send features once the window has room; after a signal, drop them if it is full."""
        while self.features.window.full and not self._process.ending.signalled:
            self.features.poll(POLL_SECONDS)
            self._poll()
        self._complete &= not self.features.window.full
        if self._complete:
            self.features.send(features)

    def publish(self, tracks: Tracks | End, features: Features | End) -> None:
        """Publish a frame to all subscribers: a message with the track of each object, and one with the features."""
        for track in tracks.tracks.values() if isinstance(tracks, Tracks) else (tracks,):
            self._tracks.send(track)
        self._copies.send(features)

    def end(self, seq: int, counters: Callable[[], dict[str, float]]) -> End:
        """Send the end after message `seq` to the compressor and, once all messages are stored, to the consumer.

        Returns the end, with the `counters` of the source in its totals. Without a signal, there is no timeout.
        """
        ending, window = self._process.ending, self.features.window
        self._send_features(End(seq, ending.reason, ending.failed))
        while self._complete and window.acknowledged <= seq and ending.seconds_since_signal <= _FEATURES_END_SECONDS:
            self.features.poll(POLL_SECONDS)
            self._poll()
        totals = {"sent": float(seq), "stored": float(min(window.stored, seq))} | counters()
        totals.pop("lost_seconds", None)  # a momentary value, not a total
        end = End(seq, ending.reason, ending.failed, totals)
        if self._results is not None:
            self._results.send(end)
            self._wait_for_consumer(math.inf, _RESULTS_END_SECONDS)
        return end

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class Previews(Publisher[Preview]):
    """Publishes the newest frame as a small picture, at most ten times a second, if there are subscribers.

    With `stores`, it stores the frames of the last previews while there are subscribers.
    """

    def __init__(self, endpoint: Endpoint, *, stores: bool = False) -> None:
        super().__init__(PREVIEWS, endpoint)
        self._pending: tuple[int, Frame, dict[str, Box]] | None = None
        self._sent_at = 0.0
        self._stores, self._frames = stores, deque[Frame]()

    def show(self, number: int, frame: Frame, boxes: dict[str, Box]) -> None:
        """Send a preview of a frame, or of a newer one if the interval has not elapsed. The image must not change."""
        self._pending = number, frame, boxes
        self.serve()

    def since(self, time: float) -> list[Frame]:
        """The stored frames from the preview with this time on; empty if it is no longer stored."""
        frames = [frame for frame in self._frames if frame.time >= time]
        return frames if frames and frames[0].time == time else []

    def serve(self) -> None:
        """Send the pending preview once the interval has elapsed. Call once per iteration, to serve new subscribers."""
        self.serve_late_joiners()
        if not self.has_subscribers:
            self._frames.clear()
        if self._pending is None or not self.has_subscribers or monotonic() - self._sent_at < _PREVIEW_SECONDS:
            return
        (number, frame, boxes), self._pending, self._sent_at = self._pending, None, monotonic()
        height, width = frame.image.shape[:2]
        self.send(Preview(number, frame.time, width, height, boxes, jpeg(frame.image, _SIDE)))
        if self._stores:
            most = max(1, _STORED_BYTES // frame.image.nbytes)
            self._frames.append(frame)
            while self._frames[0].time < frame.time - _STORED_SECONDS or len(self._frames) > most:
                self._frames.popleft()

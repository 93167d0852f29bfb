"""Receives a run in the process that started it: its tracks, its health, its end, and the exits of its processes."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Generator
from contextlib import ExitStack
from pathlib import Path
from time import monotonic
from typing import Self

from catstream.errors import ServiceError, VideoError
from catstream.messages.kinds import End, Health, ObjectPosition, Position, Track, Tracks
from catstream.run.job import Job
from catstream.services.start_server import start_server_lines
from catstream.services.supervisor import Supervisor
from catstream.services.timing import EXIT_SECONDS, LOOK_SECONDS, TURN_SECONDS
from catstream.wire.acknowledged import Receiver
from catstream.wire.channels import HEALTH, RESULTS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber
from catstream.wire.readable import Turns, Wait

_log = logging.getLogger(__name__)


class RunReader:
    """The owner of a run: starts its processes, receives and acknowledges the tracks; a context manager.

    Parameters
    ----------
    job : the job of the run, with its endpoint
    endpoint : the endpoint
    start : the track after which the run continues
    folder : private folder of this process
    live : whether the source is live; its detector then logs what the user has to know

    Attributes
    ----------
    supervisor : the processes
    end : the last message of the run; None before it was received
    rows : number of tracks that were received
    health : the newest health report of each process, by its name
    """

    def __init__(self, job: Job, endpoint: Endpoint, start: Position, folder: Path, *, live: bool) -> None:
        self.end: End | None = None
        self.rows = 0
        self._before = self._last = start  # the positions of the last two frames
        self.health: dict[str, Health] = {}
        self._live = live
        boxes = {name: ObjectPosition(box) for name, box in job.boxes.items()}
        self._found = boxes | start.objects  # where each object was last
        self._rest: deque[Track] = deque()  # tracks of a frame that `next_track` has not returned yet
        self._checked = 0.0
        self._turns = Turns("pipeline")
        self._processes = ExitStack()
        with ExitStack() as stack:
            window = job.settings.run.unstored_frames
            self._incoming = stack.enter_context(Receiver(RESULTS, endpoint, start, window))
            self._reports = stack.enter_context(Subscriber(HEALTH, endpoint))
            self.supervisor = Supervisor(job, folder)
            self._processes.callback(self.supervisor.stop, self._receive_rest)
            self._stack = stack.pop_all()

    @property
    def position(self) -> Position:
        """Of the last frame of which all tracks were returned, at first that after which the run starts."""
        return self._before if self._rest else self._last

    def next_track(self) -> Generator[Wait, None, Track | None]:
        """Wait for the next track, and return it; None at the end. A frame may have been read in part before.

        Raises
        ------
        ServiceError, VideoError
            As `next_frame`.
        """
        while not self._rest:
            tracks = yield from self.next_frame()
            if tracks is None:
                return None
            self._rest.extend(tracks.values())
        return self._rest.popleft()

    def next_frame(self, seconds: float = math.inf) -> Generator[Wait, None, dict[str, Track] | None]:
        """Wait for the next frame, and return the track of each object; None at the end, once the detector has exited.

        Parameters
        ----------
        seconds : time without a frame after which an empty mapping is returned

        Raises
        ------
        ServiceError
            If a process fails repeatedly.
        VideoError
            At the end, if the source failed.
        """
        return (yield from self._turns.run(self._next_frame(seconds)))

    def _next_frame(self, seconds: float) -> Generator[Wait, None, dict[str, Track] | None]:
        deadline = monotonic() + seconds
        while self.end is None:
            tracks = self._receive()
            if (now := monotonic()) - self._checked > TURN_SECONDS:
                self._checked = now
                self._check_processes(delivers=tracks is not None)
            if tracks is not None:
                return tracks.tracks
            if now >= deadline:
                return {}
            if not self._incoming.pending():
                yield Wait([self._incoming.fileno()], min(TURN_SECONDS, deadline - now))
        yield from self._exit()
        if self.end.failed:
            raise VideoError(self.end.reason)
        return None

    def receive_health(self) -> None:
        """Receive the health reports that have arrived, and log each new problem."""
        for report in self._reports.receive_all():
            before = self.health.get(report.process)
            if report.trouble and (before is None or before.trouble != report.trouble):
                _log.warning("%s: %s", report.process, report.trouble)
            self.health[report.process] = report

    def stop(self) -> None:
        """End the processes in order, and receive what they still send, so that none waits for that."""
        self._turns.close()
        with self._processes:
            self.receive_health()

    def close(self) -> None:
        """End the processes, and close the sockets."""
        with self._stack:
            self.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _receive(self) -> Tracks | None:
        """The tracks of the next frame if they have arrived; they are acknowledged."""
        message = self._incoming.receive(0)
        if isinstance(message, Tracks):
            self._found = {
                name: ObjectPosition(each.box) if each.box is not None else self._found.get(name, ObjectPosition())
                for name, each in message.tracks.items()
            }
            self._before, self._last = self._last, Position(message.seq, message.frame, self._found)
            self._incoming.acknowledge(self._last)
            self.rows += len(message.tracks)
            return message
        if message is not None:
            self._incoming.acknowledge(Position(self._incoming.window.taken))
            self.end = message
        return None

    def _receive_rest(self) -> None:
        """Receive the tracks that nobody reads any more."""
        while self._incoming.receive(0) is not None:
            self._incoming.acknowledge(Position(self._incoming.window.taken))

    def _check_processes(self, *, delivers: bool) -> None:
        """Receive the health, restart processes that died, and log warnings for the user."""
        self.receive_health()
        self.supervisor.check_children(delivers=delivers)
        for line in [*start_server_lines(), *(self.supervisor.new_lines("detector") if self._live else ())]:
            _log.warning("%s", line)  # kernels are compiled; a live source was lost or is available again
        if self.supervisor.finished and self.end is None and not delivers and not self._incoming.pending():
            raise ServiceError("a signal ended the detector, which has sent no end: start the run again, or resume it")

    def _exit(self) -> Generator[Wait, None, None]:
        """Wait until the detector has exited; it does so once its last message is acknowledged."""
        deadline = monotonic() + EXIT_SECONDS
        while not self.supervisor.finished and monotonic() < deadline:
            yield Wait([], LOOK_SECONDS)
            self._incoming.receive(0)
            self.receive_health()
            self.supervisor.check_children()
        self.receive_health()

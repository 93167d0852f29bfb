"""How far a stream is stored, and when a checkpoint is due: pure decisions; nothing is written here."""

from __future__ import annotations

from dataclasses import dataclass, replace

from catstream.messages import End, Position

__all__ = ["Progress"]


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of a receiver that stores what it receives.

    position  the answer to a sender: it need not repeat what comes before
    stored    seq of the newest message that is in a checkpoint
    tried     moment at which the last checkpoint was tried
    """

    position: Position
    stored: int
    tried: float

    def is_urgent(self, seq: int, window: int) -> bool:
        """Whether half of the sender's window waits to be stored: a full window would stop the sender."""
        return 2 * (seq - self.position.seq) >= window

    def is_due(self, seq: int, now: float, interval: float) -> bool:
        """Whether there are messages that are not stored, and the interval between checkpoints is over."""
        return seq > self.stored and now - self.tried >= interval

    def after(self, position: Position, now: float, *, saved: bool, urgent: bool) -> Progress:
        """The progress after a checkpoint was tried.

        If the disk takes nothing, an urgent checkpoint counts although it is in memory only: learning goes on.

        Parameters
        ----------
        position : of the newest message that was received
        saved : whether the checkpoint was written
        urgent : whether the sender waits for it
        """
        stored = position.seq if saved else self.stored
        if not saved and not urgent:
            return replace(self, tried=now)
        return Progress(replace(position, unsaved=position.seq - stored), stored, now)

    def acknowledgement(self, version: int, end: End | None) -> Position:
        """The position to acknowledge.

        A sample needs no checkpoint: in lockstep the detector waits for its model. The end of a stream holds no
        features, so it is stored with the messages before it.

        Parameters
        ----------
        version : of the newest sample
        end : the end of the stream, if it was received
        """
        position = replace(self.position, version=version)
        if end is None:
            return position
        return replace(position, seq=end.seq, unsaved=position.unsaved and position.unsaved + 1)

"""The stored part of a stream, and when a checkpoint is due: pure decisions without I/O."""

from __future__ import annotations

from dataclasses import dataclass, replace

from catstream.messages.kinds import End, Position

_REST = 9.0  # from one checkpoint to the next, times the duration of the last one


@dataclass(frozen=True, slots=True)
class StoredPart:
    """What a receiver has stored of a stream, and when it tried to store more.

    position  the answer to a sender: messages up to it need not be retransmitted
    tried     moment at which the last attempt to write a checkpoint ended
    took      seconds that it took
    """

    position: Position
    tried: float
    took: float = 0.0

    @property
    def stored(self) -> int:
        """Seq of the newest message that is in a checkpoint."""
        return self.position.seq - self.position.unsaved

    def is_due(self, seq: int, now: float, interval: float) -> bool:
        """Whether some messages are not stored, and the interval between checkpoints is over.

        The interval grows with the trees: at most a tenth of the time is spent writing.
        """
        return seq > self.stored and now - self.tried >= max(interval, _REST * self.took)

    def after(self, position: Position, began: float, now: float, *, saved: bool, urgent: bool) -> StoredPart:
        """The stored part after an attempt to write a checkpoint.

        If the disk is full, an urgent checkpoint is acknowledged although it is only in memory: training continues.

        Parameters
        ----------
        position : position of the newest received message
        began, now : moments at which the attempt began and ended
        saved : whether the checkpoint was written
        urgent : whether the sender waits for it
        """
        if not saved and not urgent:
            return replace(self, tried=now, took=now - began)
        return StoredPart(replace(position, unsaved=0 if saved else position.seq - self.stored), now, now - began)

    def acknowledgement(self, now: Position, end: End | None) -> Position:
        """The position to acknowledge.

        A sample is acknowledged without a checkpoint, because in lockstep the detector waits for its model. The end of
        a stream contains no features, so it counts as stored with the messages before it.

        Parameters
        ----------
        now : position of the newest received message, with the newest samples
        end : the end of the stream, if it was received
        """
        position = replace(self.position, objects=now.objects)
        if end is None or end.seq <= position.seq:
            return position
        return replace(position, seq=end.seq, unsaved=position.unsaved and position.unsaved + 1)

"""Decides how a live source reconnects after a loss: a table, without I/O and without a clock.

An address has one or two modes of reading, the preferred one first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

_FIRST_BACKOFF, _LONGEST_BACKOFF = 0.25, 8.0

#: H.264 in RTP packets without FFmpeg's parser; FFmpeg's demuxer and parser; its demuxer that searches for JPEGs only.
Mode = Literal["rtp", "parsed", "jpegs"]

#: The server closed the connection; no frame arrived in time; FFmpeg cannot read the data; any other error.
Kind = Literal["ended", "silent", "invalid", "failed"]

#: The next mode after a loss, by the kind of the loss and by whether the mode has delivered a frame.
TABLE: dict[tuple[Kind, bool], Literal["keep", "first", "other"]] = {
    ("ended", True): "keep",
    ("ended", False): "first",
    ("silent", True): "keep",
    ("silent", False): "other",
    ("invalid", True): "other",
    ("invalid", False): "other",
    ("failed", True): "keep",
    ("failed", False): "first",
}


@dataclass(frozen=True, slots=True)
class Loss:
    """The end of a connection.

    kind    see `Kind`
    frames  number of frames that it delivered
    reason  for log lines and errors
    """

    kind: Kind
    frames: int = 0
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Attempt:
    """An attempt to connect.

    mode     how the stream is read
    begin    "backoff": after a pause; "poll": when the next still picture is due; "at once": in the other mode
    proven   whether the mode has delivered a frame of this source
    backoff  upper bound of the pause, in seconds; it doubles with every attempt until a frame arrives
    """

    mode: Mode
    begin: Literal["backoff", "poll", "at once"] = "at once"
    proven: bool = False
    backoff: float = 0.0


def next_attempt(attempt: Attempt, loss: Loss, modes: Sequence[Mode]) -> Attempt:
    """Return the attempt that follows an attempt which ended with `loss`.

    >>> refused = Loss("failed", reason="connection refused")
    >>> next_attempt(Attempt("parsed"), refused, ["parsed"])
    Attempt(mode='parsed', begin='backoff', proven=False, backoff=0.25)
    >>> next_attempt(Attempt("parsed"), Loss("invalid"), ["parsed", "jpegs"])
    Attempt(mode='jpegs', begin='at once', proven=False, backoff=0.0)
    """
    proven = attempt.proven or loss.frames > 0
    backoff = 0.0 if loss.frames else attempt.backoff
    change = TABLE[loss.kind, proven]
    if change == "other" and attempt.mode != modes[-1]:
        return Attempt(modes[-1], backoff=backoff)
    mode, proven = (attempt.mode, proven) if change == "keep" else (modes[0], False)
    if loss.kind == "ended" and loss.frames == 1 and "jpegs" in modes:  # a still picture
        return Attempt(mode, "poll", proven, backoff)
    return Attempt(mode, "backoff", proven, min(max(_FIRST_BACKOFF, 2 * backoff), _LONGEST_BACKOFF))

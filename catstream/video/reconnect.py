"""Decides how a live source connects again after a loss: a table, without I/O and without a clock.

Over HTTP there are two demuxers to try: the one that FFmpeg selects by probing, and its demuxer "mjpeg", which searches
for JPEGs only. All other addresses are always probed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

_FIRST_BACKOFF, _LONGEST_BACKOFF = 0.25, 8.0

#: The server closed the connection; nothing or no frame arrived in time; FFmpeg cannot read the data; any other error.
Kind = Literal["ended", "silent", "invalid", "failed"]

#: What happens to the demuxer after a loss, by the kind of the loss and by whether the demuxer has delivered a frame.
TABLE: dict[tuple[Kind, bool], Literal["keep", "probe", "other"]] = {
    ("ended", True): "keep",
    ("ended", False): "probe",
    ("silent", True): "keep",
    ("silent", False): "other",
    ("invalid", True): "other",
    ("invalid", False): "other",
    ("failed", True): "keep",
    ("failed", False): "probe",
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

    begin    "backoff": after a pause; "poll": when the next still picture is due; "at once": for the other demuxer
    demuxer  "mjpeg"; None if FFmpeg probes
    proven   whether the demuxer has delivered a frame of this source
    backoff  upper bound of the pause, in seconds; it doubles with every attempt until a frame arrives
    """

    begin: Literal["backoff", "poll", "at once"] = "at once"
    demuxer: Literal["mjpeg"] | None = None
    proven: bool = False
    backoff: float = 0.0


def next_attempt(attempt: Attempt, loss: Loss, *, is_http: bool) -> Attempt:
    """Return the attempt that follows an attempt which ended with `loss`.

    >>> refused = Loss("failed", reason="connection refused")
    >>> next_attempt(Attempt(), refused, is_http=False)
    Attempt(begin='backoff', demuxer=None, proven=False, backoff=0.25)
    >>> next_attempt(Attempt(), Loss("invalid"), is_http=True)
    Attempt(begin='at once', demuxer='mjpeg', proven=False, backoff=0.0)
    """
    proven = attempt.proven or loss.frames > 0
    backoff = 0.0 if loss.frames else attempt.backoff
    change = TABLE[loss.kind, proven]
    if change == "other" and is_http and attempt.demuxer is None:
        return Attempt("at once", "mjpeg", backoff=backoff)
    demuxer = attempt.demuxer if change == "keep" else None
    proven = proven and change == "keep"
    if loss.kind == "ended" and loss.frames == 1 and is_http:  # a still picture
        return Attempt("poll", demuxer, proven, backoff)
    return Attempt("backoff", demuxer, proven, min(max(_FIRST_BACKOFF, 2 * backoff), _LONGEST_BACKOFF))

"""What this process refused: counted by reason for its health, and logged once for each cause.

A message, by what is wrong with it: `catstream.errors.ProtocolError` has the reasons. A connection,
where the pipeline has keys, by what is wrong with those of the peer: "handshake" (it has none, or
of another pipeline), "key" (it is not allowed), "role", "unreadable" (the files of keys here).
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, OrderedDict

__all__ = ["count", "refusals", "refuse"]

_REMEMBERED = 1024  # causes that are not logged again, the last ones

_log = logging.getLogger(__name__)
_lock = threading.Lock()  # the gate has a thread of its own
_counts: Counter[str] = Counter()
_told: OrderedDict[tuple[str, str, str], None] = OrderedDict()


def refuse(channel: str, reason: str, text: str, once: str = "") -> None:
    """Count what was refused on a channel, and log it unless the same was logged before.

    Parameters
    ----------
    once : who, where that is known: each is logged once
    """
    cause = channel, reason, once
    with _lock:
        _counts.update(["refused", f"refused_{reason}"])
        known = cause in _told
        _told[cause] = None
        _told.move_to_end(cause)
        if len(_told) > _REMEMBERED:
            _told.popitem(last=False)
    if not known:
        _log.warning("%s: %s", channel, text)


def count(name: str) -> None:
    """Count what health tells beside refusals."""
    with _lock:
        _counts[name] += 1


def refusals() -> dict[str, float]:
    """How often each happened in this process: for its health."""
    with _lock:
        return {"refused": 0, **{name: float(times) for name, times in sorted(_counts.items())}}

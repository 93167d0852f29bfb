"""Rejected messages and connections: counted by reason for the health, and logged once for each cause.

Messages are counted by what is wrong with them: `catstream.errors.ProtocolError` has the reasons. If the pipeline has
keys, connections are counted by what is wrong with the keys of the peer: "handshake" (it has none, or those of another
pipeline), "key" (it is not allowed), "role" (it may do less), "unreadable" (the list of clients cannot be read here).
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, OrderedDict

_MAX_CAUSES = 1024  # causes that are remembered, the newest ones; each is logged once

_log = logging.getLogger(__name__)
_lock = threading.Lock()  # the ZAP handler has a thread of its own
_counts: Counter[str] = Counter()
_logged: OrderedDict[tuple[str, str, str], None] = OrderedDict()


def reject(channel: str, reason: str, text: str, once: str = "") -> None:
    """Count what was rejected on a channel, and log it unless the same cause was logged before.

    Parameters
    ----------
    once : the peer, if it is known: each is logged once
    """
    cause = channel, reason, once
    with _lock:
        _counts.update(["rejected", f"rejected_{reason}"])
        known = cause in _logged
        _logged[cause] = None
        _logged.move_to_end(cause)
        if len(_logged) > _MAX_CAUSES:
            _logged.popitem(last=False)
    if not known:
        _log.warning("%s: %s", channel, text)


def count(name: str) -> None:
    """Count something that health reports beside the rejects."""
    with _lock:
        _counts[name] += 1


def rejects() -> dict[str, float]:
    """How often each happened in this process, for its health."""
    with _lock:
        return {"rejected": 0, **{name: float(times) for name, times in sorted(_counts.items())}}

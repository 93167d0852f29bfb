"""How many messages and connections this process has rejected; each cause is logged once."""

from __future__ import annotations

import logging
import threading
from collections import Counter

from catstream.base.forks import after_fork

_MOST_CAUSES = 1024  # that are remembered

_log = logging.getLogger(__name__)
_lock = threading.Lock()  # the ZAP handler has a thread of its own
_counts: Counter[str] = Counter()
_logged: set[tuple[str, str]] = set()


def _begin_copy() -> None:
    global _lock
    _lock = threading.Lock()  # another thread of the original may have held it


after_fork(_begin_copy)


def reject(channel: str, cause: str, text: str) -> None:
    """Count a message or a connection that was rejected on a channel, and log it unless its cause was logged before."""
    with _lock:
        _counts["rejected"] += 1
        was_logged = (channel, cause) in _logged
        if len(_logged) >= _MOST_CAUSES:
            _logged.clear()
        _logged.add((channel, cause))
    if not was_logged:
        _log.warning("%s: %s", channel, text)


def rejects() -> dict[str, float]:
    """How many messages and connections this process has rejected, and how many connections ended, for its health."""
    return {name: float(_counts[name]) for name in ("rejected", "disconnected")}


def disconnected() -> None:
    """Count a connection that has ended."""
    _counts["disconnected"] += 1

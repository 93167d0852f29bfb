"""How many messages and connections this process has rejected, for its health; each cause is logged once."""

from __future__ import annotations

import logging
import threading

from catstream.base.forks import after_fork

_MOST_CAUSES = 1024  # that are remembered

_log = logging.getLogger(__name__)
_lock = threading.Lock()  # the ZAP handler has a thread of its own
_rejected = 0
_logged: set[tuple[str, str]] = set()


def _begin_copy() -> None:
    global _lock
    _lock = threading.Lock()  # another thread of the original may have held it


after_fork(_begin_copy)


def reject(channel: str, cause: str, text: str) -> None:
    """Count a message or a connection that was rejected on a channel, and log it unless its cause was logged before."""
    global _rejected
    with _lock:
        _rejected += 1
        was_logged = (channel, cause) in _logged
        if len(_logged) >= _MOST_CAUSES:
            _logged.clear()
        _logged.add((channel, cause))
    if not was_logged:
        _log.warning("%s: %s", channel, text)


def rejected() -> int:
    """How many messages and connections this process has rejected."""
    return _rejected

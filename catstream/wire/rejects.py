"""Counts the messages and connections that this process has rejected; each cause is logged once."""

from __future__ import annotations

import logging
import threading

from catstream.base.forks import after_fork

_MOST_CAUSES = 1024  # maximum size of `_logged`

_log = logging.getLogger(__name__)
_lock = threading.Lock()  # the ZAP handler runs in its own thread
_rejected = 0
_logged: set[tuple[str, str]] = set()


def _reset_after_fork() -> None:
    global _lock
    _lock = threading.Lock()  # another thread of the parent may have locked it


after_fork(_reset_after_fork)


def reject(channel: str, cause: str, text: str) -> None:
    """Count a rejected message or connection, and log it unless its cause was logged before."""
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
    """The number of messages and connections that this process has rejected."""
    return _rejected

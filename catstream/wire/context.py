"""The ZeroMQ context of all sockets of catstream in a process, not of the user's own; and a wait for a socket."""

from __future__ import annotations

import os
from functools import cache

import zmq
import zmq.utils.garbage  # with the first message that is not copied, zmq would import it

_POLLIN = int(zmq.POLLIN)  # an operation with a member of an enumeration would take half as long as to look


@cache
def context() -> zmq.Context[zmq.Socket[bytes]]:
    """Return the context; a process that was forked gets its own.

    Only the limit of open files of the process limits the number of its sockets.
    """
    made = zmq.Context()
    made.set(zmq.MAX_SOCKETS, made.get(zmq.SOCKET_LIMIT))
    return made


def arrives(socket: zmq.Socket[bytes], seconds: float) -> bool:
    """Return whether a socket has a message, or gets one within so many seconds."""
    # To look costs half as much as `poll`, and most sockets that are looked at have no message.
    has_message = int(socket.get(zmq.EVENTS)) & _POLLIN != 0
    return has_message or (seconds > 0 and bool(socket.poll(round(seconds * 1000))))


os.register_at_fork(after_in_child=context.cache_clear)

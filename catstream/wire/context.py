"""The ZeroMQ context of all sockets of catstream in a process, apart from that of the user's own sockets."""

from __future__ import annotations

import os
from functools import cache

import zmq
import zmq.utils.garbage  # with the first message that is not copied, zmq would import it

__all__ = ["context"]


@cache
def context() -> zmq.Context[zmq.Socket[bytes]]:
    """Return the context; a process that was forked gets its own."""
    return zmq.Context()


os.register_at_fork(after_in_child=context.cache_clear)

"""HTTP connections with time-outs and a limit on their number, so that one client cannot block the server."""

from __future__ import annotations

import asyncio
from typing import cast

from uvicorn.protocols.http.h11_impl import H11Protocol

__all__ = ["MAX_CONNECTIONS", "Connection"]

#: Maximum number of open connections.
MAX_CONNECTIONS = 256

_REQUEST_SECONDS = 5.0  # time-out for a client to send a request with its body
_ANSWER_SECONDS = 20.0  # time-out for a client that does not read its response


class Connection(H11Protocol):
    """An HTTP/1.1 connection with time-outs for its client.

    If more than `MAX_CONNECTIONS` are open, the one that has kept the server waiting for longest is closed.
    A new client is therefore always answered, even if many open connections come from one address, as behind a proxy. A
    connection whose response is in preparation is never closed.

    waiting_since : time at which the server began to wait for this client, by the clock of the event loop: for a
        request, for the rest of one, or for the client to read the response. None while it does not wait
    """

    waiting_since: float | None = None
    _timer: asyncio.TimerHandle | None = None
    _closed = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        super().connection_made(transport)
        self._wait_for_client(_REQUEST_SECONDS)
        others = [cast(Connection, other) for other in self.connections]
        there = [other for other in others if not other._closed]
        waiting = [other for other in there if other.waiting_since is not None]
        if len(there) > MAX_CONNECTIONS:  # `waiting` is not empty: this new connection waits for its request
            min(waiting, key=lambda other: other.waiting_since or 0.0).abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._timer is None and self._between_requests:
            self._wait_for_client(_REQUEST_SECONDS)  # the first bytes of the next request
        super().data_received(data)
        self._update_wait()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._update_wait()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._wait_for_client(_ANSWER_SECONDS)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stop_waiting()
        self._update_wait()

    def abort(self) -> None:
        """Close the connection at once, and drop unsent data."""
        self._closed = True
        self._stop_waiting()
        self.transport.abort()

    @property
    def _between_requests(self) -> bool:
        return self.cycle is not None and self.cycle.response_complete and not self.cycle.more_body

    def _update_wait(self) -> None:
        """Start or stop the time-out, by whether the server waits for the client now."""
        if self._closed or self.flow.write_paused:
            return
        if self.cycle is not None and not self.cycle.more_body and not self.cycle.response_complete:
            self._stop_waiting()
        elif (
            self._between_requests and not self.conn.trailing_data[0]
        ):  # an idle connection has the time-out `timeout_keep_alive`
            self._stop_waiting()
            self.waiting_since = self.loop.time()
        elif self._timer is None:
            self._wait_for_client(_REQUEST_SECONDS)

    def _wait_for_client(self, seconds: float) -> None:
        """Start a time-out for the client."""
        self._stop_waiting()
        self.waiting_since = self.loop.time()
        self._timer = self.loop.call_later(seconds, self.abort)

    def _stop_waiting(self) -> None:
        self.waiting_since = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

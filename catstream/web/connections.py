"""Time-outs of connections and a limit on their number, so that one client cannot block the server.

The server waits for a client until its request is complete, and while the client does not read the response. If more
than `MAX_CONNECTIONS` are open, the one whose client it has waited for longest is closed; if all others are open pages,
the new one. A new client is therefore answered even if many open connections come from one address, as behind a proxy.
"""

from __future__ import annotations

import asyncio
from typing import Any

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from catstream.errors import ProtocolError
from catstream.web.timing import ANSWER_SECONDS, REQUEST_SECONDS

#: Maximum number of open connections.
MAX_CONNECTIONS = 256

_MAX_BODY = 4096  # bytes


class Connections:
    """The open connections of a server; it is the server's application, and passes each request on to another one."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self.open: dict[tuple[str, int], _Connection] = {}  # by the address and port of the client
        self.waiting: dict[_Connection, asyncio.TimerHandle] = {}  # those that wait for their client, longest first

    def protocol(self, **of_uvicorn: Any) -> asyncio.Protocol:
        """Return the protocol of a new connection."""
        return _Connection(self, H11Protocol(**of_uvicorn))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        connection = self.open.get(scope["client"]) if scope.get("client") else None
        if connection is not None:
            connection.change(answering=1)
        try:
            await self._app(scope, receive, send)
        finally:
            if connection is not None:
                connection.change(answering=-1)


class _Connection(asyncio.Protocol):
    """One connection: passes everything on to uvicorn's protocol, and measures how long it waits for the client."""

    def __init__(self, all_: Connections, inner: asyncio.Protocol) -> None:
        self._all, self._inner = all_, inner
        self._answering = 0  # requests; two if the application has not returned from the one before
        self._paused = False

    def change(self, *, answering: int = 0, paused: bool | None = None) -> None:
        """Start or stop a time-out: an answer begins (1) or ends (-1); the client does not read, or reads again."""
        self._answering += answering
        self._paused = self._paused if paused is None else paused
        if (timer := self._all.waiting.pop(self, None)) is not None:
            timer.cancel()
        if self._address in self._all.open and (self._paused or not self._answering):
            seconds = ANSWER_SECONDS if self._paused else REQUEST_SECONDS
            self._all.waiting[self] = asyncio.get_running_loop().call_later(seconds, self._abort)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        self._transport, self._address = transport, tuple(transport.get_extra_info("peername")[:2])
        self._all.open[self._address] = self
        self._inner.connection_made(transport)
        self.change()
        if len(self._all.open) > MAX_CONNECTIONS:
            next(iter(self._all.waiting))._abort()  # at the latest the new one

    def connection_lost(self, exc: Exception | None) -> None:
        self._all.open.pop(self._address, None)
        self.change()
        self._inner.connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        return self._inner.eof_received()

    def pause_writing(self) -> None:
        self._inner.pause_writing()
        self.change(paused=True)

    def resume_writing(self) -> None:
        self._inner.resume_writing()
        self.change(paused=False)

    def _abort(self) -> None:
        """Close the connection at once, and drop unsent data."""
        self._all.open.pop(self._address, None)
        self.change()
        self._transport.abort()


async def body_of(request: Request) -> bytes:
    """Return the body of a request, of at most 4096 bytes."""
    body = b""
    try:
        async with asyncio.timeout(REQUEST_SECONDS):
            async for part in request.stream():
                body += part
                if len(body) > _MAX_BODY:
                    raise ProtocolError(f"expected at most {_MAX_BODY} bytes, got more")
    except TimeoutError:
        raise HTTPException(408, "the request was not complete in time\n") from None
    return body

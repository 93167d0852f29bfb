"""The web server of a page, with access control; it runs in the calling or in a background thread."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import hmac
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from urllib.parse import quote

import uvicorn
from starlette.datastructures import MutableHeaders
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from catstream.errors import ServiceError
from catstream.web.annotator import AnnotationSite
from catstream.web.app import Site
from catstream.web.wall import Wall

_LOGIN_PAGE = Path(__file__).with_name("page") / "login.html"
_PUBLIC_PATHS = ("/healthz", "/readyz", "/page/")  # reveal only the readiness of the pipeline

_MIN_TOKEN_LENGTH = 16
_LOOPBACK = ("127.0.0.1", "::1", "localhost")

SHUTDOWN_SECONDS = 2  #: timeout of the shutdown for stalled responses; twice this for commands
KEEP_ALIVE_SECONDS = 5  #: time without a request after which a connection is closed
_MAX_CONNECTIONS = 256
_MAX_HEADERS = 16384  # bytes

#: Headers of all responses: no content from other hosts, no inline scripts, no frames.
_HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}


class Server:
    """The web server of a site, with access control. The constructor begins to listen; port 0 selects a free port.

    Clients need the token. Without one, which is allowed only on loopback, each user of this machine can watch and send
    commands. `url` is for a browser on this machine, with the token; `urls` has a second URL for other machines if the
    server listens on all interfaces. If the port is in use, the next `attempts - 1` ports are tried. ServiceError if
    the page would be public without a token, the token is too short, or the ports are in use.
    """

    def __init__(
        self,
        site: Site | Wall | AnnotationSite,
        *,
        host: str = "127.0.0.1",
        port: int = 8000,
        token: str | None = None,
        attempts: int = 1,
    ) -> None:
        if token is None and host not in _LOOPBACK:
            raise ServiceError(
                f"{host} can be reached from other machines, and anyone who opens the page may control the pipeline: "
                "serve it with a token (without VIEW_TOKEN=none), or listen on 127.0.0.1"
            )
        app = Guard(site.app, token)
        self._socket = _listen(host, port, attempts)
        end = f":{self._socket.getsockname()[1]}/" + (f"?token={quote(token, safe='')}" if token else "")
        hosts = ["127.0.0.1", socket.gethostname()] if host in ("0.0.0.0", "::") else [host]
        self.urls = [f"http://{f'[{name}]' if ':' in name else name}{end}" for name in hosts]
        self.url = self.urls[0]
        config = uvicorn.Config(
            app,
            http="h11",
            ws="none",
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            limit_concurrency=_MAX_CONNECTIONS,
            timeout_keep_alive=KEEP_ALIVE_SECONDS,
            timeout_graceful_shutdown=2 * SHUTDOWN_SECONDS,
            h11_max_incomplete_event_size=_MAX_HEADERS,
        )
        self._server = _Uvicorn(config, site.close)

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM."""
        with contextlib.suppress(KeyboardInterrupt):  # uvicorn raises it after its shutdown
            self._server.run([self._socket])

    @contextlib.contextmanager
    def in_background(self) -> Iterator[None]:
        """Serve in a background thread inside a `with`."""
        thread = threading.Thread(target=self._server.run, args=([self._socket],), name="view", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._server.should_exit = True
            thread.join()


class _Uvicorn(uvicorn.Server):
    """Closes the streams of open pages before the shutdown, which waits for all connections.

    A second Ctrl-C is ignored: uvicorn would skip the shutdown of the site, and print a traceback.
    """

    def __init__(self, config: uvicorn.Config, close: Callable[[], None]) -> None:
        super().__init__(config)
        self._close = close

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        if not self.should_exit:
            super().handle_exit(sig, frame)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._close()
        asyncio.get_running_loop().call_later(SHUTDOWN_SECONDS, self._abort_stalled)
        await super().shutdown(sockets)

    def _abort_stalled(self) -> None:
        """Abort connections that do not read: uvicorn would cancel their responses, and log a traceback for each."""
        for connection in list(self.server_state.connections):
            if connection.transport.get_write_buffer_size():
                connection.transport.abort()


def _listen(host: str, port: int, attempts: int) -> socket.socket:
    """Listen on a port, or on the next free one of `attempts` ports."""
    try:
        families = {family for family, *_ in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
        if socket.AF_INET not in families:
            return socket.create_server((host, port), family=socket.AF_INET6, dualstack_ipv6=True)
        return socket.create_server((host, port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE and attempts > 1:
            return _listen(host, port + 1, attempts - 1)
        why = (error.strerror or str(error)).partition(" (while")[0]  # Python adds the address
        at = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        raise ServiceError(f"cannot listen on {at} ({why}): choose another port or host") from None


class Guard:
    """ASGI middleware that checks each request before an application receives it.

    With a token, a request needs `?token=TOKEN`, `Authorization: Bearer TOKEN`, or the cookie that a page sets if it is
    opened with `?token=TOKEN`. Without a token, only requests to a loopback host name are answered, which prevents DNS
    rebinding. Unsafe requests must come from a page of the same origin, or from a program, which sends no Origin
    header; this prevents CSRF. The length of the token prevents brute force.
    """

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        if token is not None and len(token) < _MIN_TOKEN_LENGTH:
            raise ServiceError(
                f"the token is too short ({len(token)} characters): use {_MIN_TOKEN_LENGTH} or more, "
                "for example VIEW_TOKEN=$(openssl rand -hex 16)"
            )
        self._app = app if token is not None else TrustedHostMiddleware(app, _LOOPBACK, www_redirect=False)
        self._token_digest = None if token is None else _digest(token)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # lifespan events of the server
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        request = Request(scope, receive)
        response = _reject_foreign(request) or self._check_token(request) or self._app
        await response(scope, receive, send_with_headers)

    def _check_token(self, request: Request) -> Response | None:
        """Return the response to a request without the token, or to a page that is opened with the token in its URL."""
        path: str = request.scope["path"]  # unlike `request.url`, independent of the client's Host header
        if self._token_digest is None or path.startswith(_PUBLIC_PATHS):
            return None
        cookie = f"catstream-{self._token_digest[:8]}"  # browsers send a cookie to all ports of a host
        in_url = request.query_params.get("token")
        kind, _, in_header = request.headers.get("authorization", "").partition(" ")
        token = in_url or (in_header if kind.lower() == "bearer" else None)
        digest = request.cookies.get(cookie, "") if token is None else _digest(token.strip())
        if hmac.compare_digest(digest.encode(), self._token_digest.encode()):
            opens_page = in_url and path.endswith("/") and request.method == "GET"
            return _enter(request, cookie, digest) if opens_page else None
        if path.endswith("/") and token is None:
            return FileResponse(_LOGIN_PAGE, 401)
        expected = "a token is needed: Authorization: Bearer TOKEN, or ?token=TOKEN"
        return PlainTextResponse(f"{expected}\n" if token is None else "this is not the token of this page\n", 401)


def _reject_foreign(request: Request) -> Response | None:
    """Return an error for an unsafe request from a page of another origin."""
    host, origin = request.headers.get("host", ""), request.headers.get("origin")
    if request.method not in ("GET", "HEAD") and origin is not None and origin.partition("://")[2] != host:
        return PlainTextResponse(f"rejected: the request comes from a page of another origin, {origin!r}\n", 403)
    return None


def _enter(request: Request, cookie: str, digest: str) -> Response:
    """Set the cookie, and redirect to the same page without the token in its URL."""
    response = RedirectResponse("./", 303)
    secure = request.headers.get("x-forwarded-proto") == "https"
    response.set_cookie(cookie, digest, httponly=True, samesite="lax", secure=secure)
    return response


def _digest(token: str) -> str:
    """Return the digest of a token, which is the value of the cookie and is compared instead of the token."""
    return hashlib.sha256(b"catstream view\0" + token.encode()).hexdigest()[:32]

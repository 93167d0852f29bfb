"""Access control of the web server: host, origin and token checks, rate limits, and security headers."""

from __future__ import annotations

import hashlib
import hmac
from collections import OrderedDict
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from time import monotonic
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from catstream.errors import ServiceError

__all__ = ["Guard", "TokenBucket", "body_of", "is_loopback", "too_many"]

_COOKIE = "catstream"  # and the port: a browser sends cookies to all ports of a host
_LOGIN_PAGE = Path(__file__).with_name("page") / "login.html"
_PUBLIC_PATHS = ("/healthz", "/readyz", "/page/")  # they reveal only whether the pipeline runs

_MIN_TOKEN_LENGTH = 16
_MAX_BODY = 4096  # bytes
_MAX_GUESSES, _GUESSES_PER_SECOND = 8, 0.2  # wrong tokens from one address
_ADDRESSES = 1024  # number of addresses with wrong tokens that are kept

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


class TokenBucket:
    """A token bucket: allows bursts of `size` requests, and `rate` requests per second on average."""

    def __init__(self, size: float, rate: float) -> None:
        self._size, self._rate = size, rate
        self._level, self._moment = size, float("-inf")

    def wait(self, now: float) -> float:
        """Return the seconds until the next request is allowed, 0 if it is allowed now."""
        self._level = min(self._size, self._level + (now - self._moment) * self._rate)
        self._moment = now
        return max(0.0, 1 - self._level) / self._rate

    def take(self) -> None:
        """Count a request."""
        self._level -= 1


class Guard:
    """ASGI middleware that checks each request before an application receives it.

    Without a token, only requests to a loopback host name are answered; this prevents DNS rebinding. With a token, a
    request must have it as `Authorization: Bearer TOKEN` or as the cookie that `POST /login` sets. Requests that change
    something must come from a page of the same origin, or from a program, which sends no Origin header; this prevents
    CSRF.

    Parameters
    ----------
    clock : function that returns seconds of a monotonic clock

    Raises
    ------
    ServiceError
        If the token is so short that it could be guessed.
    """

    def __init__(self, app: ASGIApp, token: str | None, clock: Callable[[], float] = monotonic) -> None:
        if token is not None and len(token) < _MIN_TOKEN_LENGTH:
            raise ServiceError(
                f"a token of {len(token)} characters can be guessed: give {_MIN_TOKEN_LENGTH} or more, "
                "for example VIEW_TOKEN=$(openssl rand -hex 16)"
            )
        self._app, self._clock = app, clock
        self._token_digest = None if token is None else _digest(token)
        self._guesses: OrderedDict[str, TokenBucket] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # start-up and shutdown events of the server
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        request = Request(scope, receive)
        answer: ASGIApp = self._reject_foreign(request) or self._app
        path = scope["path"]  # as in the routes; `request.url` depends on the client's Host header
        if answer is self._app and self._token_digest is not None and not path.startswith(_PUBLIC_PATHS):
            if (request.method, path) == ("POST", "/login"):
                answer = await self._log_in(request)
            else:
                answer = self._reject_without_token(request) or self._app
        await answer(scope, receive, send_with_headers)

    def _reject_foreign(self, request: Request) -> Response | None:
        """Return an error if the host name or the origin of a request is not that of this server."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if self._token_digest is None and not is_loopback(_host_name(host)):
            return PlainTextResponse(f"this page is at http://127.0.0.1, not at {host!r}\n", 421)
        if request.method not in ("GET", "HEAD") and origin is not None and origin.partition("://")[2] != host:
            return PlainTextResponse(f"rejected: the request comes from a page of another origin, {origin!r}\n", 403)
        return None

    def _reject_without_token(self, request: Request) -> Response | None:
        """Return an error if a request has no token or a wrong one."""
        shown = _credential(request)
        if shown is not None:
            return self._reject_wrong_token(shown, request)
        if request.scope["path"].endswith("/"):  # a page
            return FileResponse(_LOGIN_PAGE, 401)
        return PlainTextResponse("a token is needed: Authorization: Bearer TOKEN\n", 401)

    async def _log_in(self, request: Request) -> Response:
        """Set the cookie and redirect to the page if the posted token is correct."""
        body = await body_of(request)
        token = parse_qs(body.decode(errors="replace")).get("token", [""])[0] if body else ""
        wrong = self._reject_wrong_token(_digest(token.strip()), request)
        if wrong is not None:
            return wrong
        answer = RedirectResponse("/", 303)
        secure = request.headers.get("origin", "").startswith("https:")
        name, value = _cookie_of(request.scope), self._token_digest or ""
        answer.set_cookie(name, value, httponly=True, samesite="lax", secure=secure)
        return answer

    def _reject_wrong_token(self, shown: str, request: Request) -> Response | None:
        """Return an error for a wrong token, None for the correct one.

        The correct token is never rate-limited: behind a proxy all clients have the same address, and wrong tokens of
        one client must not lock out the others. The token is protected by its length; the limit only saves work.
        """
        if hmac.compare_digest(shown.encode(), (self._token_digest or "").encode()):
            return None
        address, now = request.client.host if request.client else "", self._clock()
        guesses = self._guesses.setdefault(address, TokenBucket(_MAX_GUESSES, _GUESSES_PER_SECOND))
        if len(self._guesses) > _ADDRESSES:
            self._guesses.popitem(last=False)
        if wait := guesses.wait(now):
            return too_many(wait)
        guesses.take()
        return PlainTextResponse("this is not the token that this page was started with\n", 401)


async def body_of(request: Request) -> bytes | None:
    """Return the body of a request, None if it is longer than 4096 bytes."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > _MAX_BODY:
            return None
    return body


def too_many(wait: float) -> Response:
    """Return the error for a client that exceeds a rate limit."""
    return PlainTextResponse("too many requests: wait\n", 429, {"retry-after": f"{wait + 0.5:.0f}"})


def is_loopback(host: str) -> bool:
    """Return whether a host is a fixed name or address of the loopback interface."""
    return host in ("127.0.0.1", "::1", "localhost")


def _host_name(host: str) -> str:
    """Return the host of a Host header without the port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _digest(token: str) -> str:
    """Return the digest of a token, which is the value of the cookie and is compared in place of the token."""
    return hashlib.sha256(b"catstream view\0" + token.encode()).hexdigest()


def _cookie_of(scope: Scope) -> str:
    """Return the name of the cookie of this server."""
    return f"{_COOKIE}-{scope['server'][1]}"


def _credential(request: Request) -> str | None:
    kind, _, token = request.headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return _digest(token.strip())
    try:
        cookie = SimpleCookie(request.headers.get("cookie", "")).get(_cookie_of(request.scope))
    except CookieError:
        return None
    return cookie.value if cookie else None

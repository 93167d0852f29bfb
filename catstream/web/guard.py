"""Access control of the web server: host, origin and token checks, rate limits, and security headers."""

from __future__ import annotations

import hashlib
import hmac
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from urllib.parse import SplitResult, urlencode, urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from catstream.errors import ServiceError

__all__ = ["Guard", "TokenBucket", "is_loopback", "too_many"]

_LOGIN_PAGE = Path(__file__).with_name("page") / "login.html"
_PUBLIC_PATHS = ("/healthz", "/readyz", "/page/")  # they reveal only whether the pipeline runs

_NEEDED = "a token is needed: Authorization: Bearer TOKEN, or ?token=TOKEN\n"
_WRONG = "this is not the token that this page was started with\n"

_MIN_TOKEN_LENGTH = 16
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
        self._full_at = float("-inf")  # time from which it is full

    def wait(self, now: float) -> float:
        """Return the seconds until the next request is allowed, 0 if it is allowed now."""
        return max(0.0, self._full_at - now - (self._size - 1) / self._rate)

    def take(self, now: float) -> None:
        """Count a request."""
        self._full_at = max(self._full_at, now) + 1 / self._rate


class Guard:
    """ASGI middleware that checks each request before an application receives it.

    With a token, a request must have it as `?token=TOKEN`, as `Authorization: Bearer TOKEN`, or as the cookie that a
    page sets if it is opened with `?token=TOKEN`. Without a token, only requests to a loopback host name are answered;
    this prevents DNS rebinding. Requests that change something must come from a page of the same origin, or from a
    program, which sends no Origin header; this prevents CSRF.

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
            answer = self._check_token(request) or self._app
        await answer(scope, receive, send_with_headers)

    def _reject_foreign(self, request: Request) -> Response | None:
        """Return an error if the host name or the origin of a request is not that of this server."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if self._token_digest is None and not is_loopback(_split(request).hostname or ""):
            return PlainTextResponse(f"this page is at http://127.0.0.1, not at {host!r}\n", 421)
        if request.method not in ("GET", "HEAD") and origin is not None and origin.partition("://")[2] != host:
            return PlainTextResponse(f"rejected: the request comes from a page of another origin, {origin!r}\n", 403)
        return None

    def _check_token(self, request: Request) -> Response | None:
        """Return the answer to a request without the token, or to a page that is opened with it in its URL.

        The correct token is never rate-limited: behind a proxy all clients have the same address, and wrong tokens of
        one client must not lock out the others. The token is protected by its length; the limit only saves work.
        """
        page, name = request.scope["path"].endswith("/"), _cookie_name(request)
        in_url, cookie = request.query_params.get("token"), request.cookies.get(name)
        kind, _, in_header = request.headers.get("authorization", "").partition(" ")
        given = in_url or (in_header if kind.lower() == "bearer" else None)
        shown = cookie if given is None else _digest(given.strip())
        if shown is not None and hmac.compare_digest(shown.encode(), (self._token_digest or "").encode()):
            return _enter(request, name, shown) if in_url and page and request.method == "GET" else None
        if shown is not None and (wait := self._count_guess(request)):
            return too_many(wait)
        if page and given is None:  # with a cookie: that of a server that ran here before
            return FileResponse(_LOGIN_PAGE, 401)
        return PlainTextResponse(_NEEDED if given is None else _WRONG, 401)

    def _count_guess(self, request: Request) -> float:
        """Count a wrong token; return the seconds to wait, if there were too many from this address."""
        address, now = request.client.host if request.client else "", self._clock()
        guesses = self._guesses.setdefault(address, TokenBucket(_MAX_GUESSES, _GUESSES_PER_SECOND))
        if len(self._guesses) > _ADDRESSES:
            self._guesses.popitem(last=False)
        wait = guesses.wait(now)
        if not wait:
            guesses.take(now)
        return wait


def too_many(wait: float) -> Response:
    """Return the error for a client that exceeds a rate limit."""
    return PlainTextResponse("too many requests: wait\n", 429, {"retry-after": f"{wait + 0.5:.0f}"})


def is_loopback(host: str) -> bool:
    """Return whether a host is a fixed name or address of the loopback interface."""
    return host in ("127.0.0.1", "::1", "localhost")


def _split(request: Request) -> SplitResult:
    """Return the Host header, with the attributes `hostname` and `port`."""
    try:
        split = urlsplit(f"//{request.headers.get('host', '')}")
        split.port  # noqa: B018  # ValueError if it is not a number
    except ValueError:
        return urlsplit("//")
    return split


def _cookie_name(request: Request) -> str:
    """Return the name of the cookie; browsers send a cookie to all ports of a host, so the name contains the port."""
    return f"catstream-{_split(request).port or 80}"


def _enter(request: Request, cookie: str, digest: str) -> Response:
    """Set the cookie, and redirect to the same page without the token in its URL."""
    query = urlencode([pair for pair in request.query_params.multi_items() if pair[0] != "token"])
    answer = RedirectResponse("./" + (f"?{query}" if query else ""), 303)
    secure = request.headers.get("x-forwarded-proto") == "https"
    answer.set_cookie(cookie, digest, httponly=True, samesite="lax", secure=secure)
    return answer


def _digest(token: str) -> str:
    """Return the digest of a token, which is the value of the cookie and is compared in place of the token."""
    return hashlib.sha256(b"catstream view\0" + token.encode()).hexdigest()

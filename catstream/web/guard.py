"""The guard: who may ask, how often, and what a browser may do with the answers."""

from __future__ import annotations

import hashlib
import hmac
from collections import OrderedDict
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from time import monotonic
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from catstream.errors import ServiceError

__all__ = ["Guard", "TokenBucket", "body_of", "is_loopback", "too_many"]

_COOKIE = "catstream"
_LOGIN_PAGE = Path(__file__).with_name("page") / "login.html"
_PUBLIC_PATHS = ("/healthz", "/readyz", "/page/")  # what tells nothing of the pipeline but whether it is there

_MIN_TOKEN_LENGTH = 16
_MAX_BODY = 4096  # bytes
_MAX_GUESSES, _GUESSES_PER_SECOND = 8, 0.2  # of each address
_ADDRESSES = 1024  # whose wrong guesses are remembered

#: What answers are sent with. Nothing is fetched from elsewhere, no script stands in a page, nobody may frame it.
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
    """Lets `size` pass at once, and `rate` a second after that."""

    def __init__(self, size: float, rate: float) -> None:
        self._size, self._rate = size, rate
        self._level, self._moment = size, float("-inf")

    def wait(self, now: float) -> float:
        """Seconds until one may pass, 0 for now."""
        self._level = min(self._size, self._level + (now - self._moment) * self._rate)
        self._moment = now
        return max(0.0, 1 - self._level) / self._rate

    def take(self) -> None:
        """Let one pass."""
        self._level -= 1


class Guard:
    """Stands before an application.

    Without a token it answers to this machine's own names only, so that no other name can be made to lead
    here (DNS rebinding). With one, it answers who shows it: as `Authorization: Bearer TOKEN`, or as the
    cookie that `POST /login` gives for it. What changes something is taken from pages of the same origin, and
    from programs, which name none (CSRF).

    Parameters
    ----------
    clock : seconds

    Raises
    ------
    ServiceError
        For a token that could be guessed.
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
        if scope["type"] != "http":  # the server's start and end
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        request = Request(scope, receive)
        answer: ASGIApp = self._reject_foreign(request) or self._app
        path = scope["path"]  # which the routes go by: that of `request.url` may begin in the client's Host header
        if answer is self._app and self._token_digest is not None and not path.startswith(_PUBLIC_PATHS):
            if (request.method, path) == ("POST", "/login"):
                answer = await self._log_in(request)
            else:
                answer = self._reject_without_token(request) or self._app
        await answer(scope, receive, send_with_headers)

    def _reject_foreign(self, request: Request) -> Response | None:
        """The answer to a name that is not ours, or to a page that is not."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if self._token_digest is None and not is_loopback(_host_name(host)):
            return PlainTextResponse(f"this page is at http://127.0.0.1, not at {host!r}\n", 421)
        if request.method not in ("GET", "HEAD") and origin is not None and origin.partition("://")[2] != host:
            return PlainTextResponse(f"refused: the page that asks is of another origin, {origin!r}\n", 403)
        return None

    def _reject_without_token(self, request: Request) -> Response | None:
        """The answer to who shows no token, or a wrong one."""
        shown = _credential(request.headers)
        if shown is not None:
            return self._reject_wrong_token(shown, request)
        if request.scope["path"] == "/":
            return FileResponse(_LOGIN_PAGE, 401)
        return PlainTextResponse("a token is needed: Authorization: Bearer TOKEN\n", 401)

    async def _log_in(self, request: Request) -> Response:
        """The cookie for a token that is right, and the way to the page."""
        body = await body_of(request)
        token = parse_qs(body.decode(errors="replace")).get("token", [""])[0] if body else ""
        wrong = self._reject_wrong_token(_digest(token.strip()), request)
        if wrong is not None:
            return wrong
        answer = RedirectResponse("/", 303)
        secure = request.headers.get("origin", "").startswith("https:")
        answer.set_cookie(_COOKIE, self._token_digest or "", httponly=True, samesite="lax", secure=secure)
        return answer

    def _reject_wrong_token(self, shown: str, request: Request) -> Response | None:
        """The answer to a wrong token, None for the right one.

        The right one always passes: behind a proxy all clients have one address, and nobody may keep others out by
        wrong tokens. The token is protected by its length; the limit only saves work.
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
    """What was posted; None where it is more than anybody needs."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > _MAX_BODY:
            return None
    return body


def too_many(wait: float) -> Response:
    """The answer to who asks too often."""
    return PlainTextResponse("too many: wait\n", 429, {"retry-after": f"{wait + 0.5:.0f}"})


def is_loopback(host: str) -> bool:
    """Whether a host is this machine, as nobody can make another name mean."""
    return host in ("127.0.0.1", "::1", "localhost")


def _host_name(host: str) -> str:
    """The host without its port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _digest(token: str) -> str:
    """What a browser keeps instead of the token, and what is compared."""
    return hashlib.sha256(b"catstream view\0" + token.encode()).hexdigest()


def _credential(headers: Headers) -> str | None:
    kind, _, token = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return _digest(token.strip())
    try:
        cookie = SimpleCookie(headers.get("cookie", "")).get(_COOKIE)
    except CookieError:
        return None
    return cookie.value if cookie else None

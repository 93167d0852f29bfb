"""Access control of the web server: host, origin and token checks, and security headers."""

from __future__ import annotations

import hashlib
import hmac
from pathlib import Path
from urllib.parse import SplitResult, urlencode, urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from catstream.errors import ServiceError

_LOGIN_PAGE = Path(__file__).with_name("page") / "login.html"
_PUBLIC_PATHS = ("/healthz", "/readyz", "/page/")  # they reveal only whether the pipeline runs

_NEEDED = "a token is needed: Authorization: Bearer TOKEN, or ?token=TOKEN\n"
_WRONG = "this is not the token that this page was started with\n"

_MIN_TOKEN_LENGTH = 16

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


class Guard:
    """ASGI middleware that checks each request before an application receives it.

    With a token, a request must have it as `?token=TOKEN`, as `Authorization: Bearer TOKEN`, or as the cookie that a
    page sets if it is opened with `?token=TOKEN`. Without a token, only requests to a loopback host name are answered;
    this prevents DNS rebinding. Requests that change something must come from a page of the same origin, or from a
    program, which sends no Origin header; this prevents CSRF. The length of the token protects it from being guessed.

    Raises
    ------
    ServiceError
        If the token is so short that it could be guessed.
    """

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        if token is not None and len(token) < _MIN_TOKEN_LENGTH:
            raise ServiceError(
                f"a token of {len(token)} characters can be guessed: give {_MIN_TOKEN_LENGTH} or more, "
                "for example VIEW_TOKEN=$(openssl rand -hex 16)"
            )
        self._app = app
        self._token_digest = None if token is None else _digest(token)

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
        """Return the answer to a request without the token, or to a page that is opened with it in its URL."""
        page, name = request.scope["path"].endswith("/"), _cookie_name(request)
        in_url, cookie = request.query_params.get("token"), request.cookies.get(name)
        kind, _, in_header = request.headers.get("authorization", "").partition(" ")
        given = in_url or (in_header if kind.lower() == "bearer" else None)
        shown = cookie if given is None else _digest(given.strip())
        if shown is not None and hmac.compare_digest(shown.encode(), (self._token_digest or "").encode()):
            return _enter(request, name, shown) if in_url and page and request.method == "GET" else None
        if page and given is None:  # with a cookie: that of a server that ran here before
            return FileResponse(_LOGIN_PAGE, 401)
        return PlainTextResponse(_NEEDED if given is None else _WRONG, 401)


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

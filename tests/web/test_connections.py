"""Connections that a client holds open: no number of them keeps others from the page. Real sockets, on loopback."""

from __future__ import annotations

import asyncio
import socket
from contextlib import ExitStack, suppress
from types import SimpleNamespace
from urllib.parse import urlsplit

import pytest

from catstream.messages.kinds import Preview
from catstream.web import connections
from catstream.web.dashboard import Dashboard

TOKEN = "correct-horse-battery"
HALF = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX-"
BEGUN = {
    "nothing": b"",
    "half a head": HALF,
    "half a body": b"POST /control HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    b"Content-Length: 20\r\n\r\n{",
    "half of the next request": b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" + HALF,
}


@pytest.fixture
def connect():
    """Opens connections to a page."""
    with ExitStack() as stack:

        def start(page):
            address = urlsplit(str(page.base_url))
            return stack.enter_context(socket.create_connection((address.hostname, address.port), timeout=60))

        yield start


def sent_until_it_is_closed(client, data):
    """Send again and again; fails with TimeoutError if the server stops reading and does not close the connection."""
    with suppress(ConnectionError):
        while True:
            client.sendall(data)


@pytest.mark.parametrize("begun", BEGUN.values(), ids=BEGUN)
def test_a_request_that_is_incomplete_after_the_timeout_closes_its_connection(serve, connect, monkeypatch, begun):
    monkeypatch.setattr(connections, "REQUEST_SECONDS", 0.05)
    client = connect(serve())
    client.sendall(begun)
    with suppress(ConnectionResetError):
        while client.recv(4096):
            pass


def test_a_request_sent_byte_by_byte_has_the_same_timeout(serve, connect, monkeypatch):
    monkeypatch.setattr(connections, "REQUEST_SECONDS", 0.05)
    client = connect(serve())
    client.sendall(HALF)
    sent_until_it_is_closed(client, b"x")


def test_a_client_that_does_not_read_its_response_is_disconnected(serve, connect, monkeypatch):
    monkeypatch.setattr(connections, "ANSWER_SECONDS", 0.05)
    monkeypatch.setattr(Dashboard, "picture", lambda *_: Preview(1, 64, 48, None, bytes(1 << 23)))
    client = connect(serve())
    sent_until_it_is_closed(client, b"GET /pictures/1.jpg HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")


@pytest.mark.parametrize("begun", [b"", HALF], ids=["nothing", "half a head"])
def test_idle_connections_cannot_block_new_clients(serve, connect, begun):
    page = serve(token=TOKEN)
    for _ in range(connections.MAX_CONNECTIONS + 50):
        connect(page).sendall(begun)
    assert page.get("/healthz").status_code == 200
    assert page.get("/metrics", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 200


def test_an_open_page_stays_connected_while_others_open_connections(serve, connect, monkeypatch):
    monkeypatch.setattr("catstream.web.feed.SILENCE_SECONDS", 0.1)  # after which the page is told of it
    page = serve()
    with page.stream("GET", "/events") as events:
        lines = events.iter_lines()
        assert next(lines) == "retry: 1000"
        assert any(line.startswith("data: ") for line in lines), "all parts"
        for _ in range(connections.MAX_CONNECTIONS + 50):
            connect(page).sendall(HALF)
        assert page.get("/healthz").status_code == 200
        assert any(line.startswith("data: ") for line in lines)


async def late(scope, receive, send):  # noqa: ARG001
    """Answers at once, and returns a while later; or answers in many parts, for longer than a request may take."""
    if scope["type"] != "http":
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    if scope["path"] == "/healthz":
        await send({"type": "http.response.body", "body": b"ok"})
        await asyncio.sleep(0.1)
        return
    for _ in range(20):
        await send({"type": "http.response.body", "body": b"part", "more_body": True})
        await asyncio.sleep(0.05)
    await send({"type": "http.response.body", "body": b"the end"})


def test_a_response_is_not_cut_off_if_the_application_returns_late_from_the_request_before(serve_site, monkeypatch):
    monkeypatch.setattr(connections, "REQUEST_SECONDS", 0.3)
    client = serve_site(SimpleNamespace(app=late, close=lambda: None))
    assert client.get("/healthz").text == "ok"
    assert client.get("/parts").text.endswith("partthe end")

"""The server of the page: access control, protection against other origins, updates, commands, and its end."""

from __future__ import annotations

import itertools
import json
import re
import signal
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import httpx
import numpy as np
import pytest

from catstream.client.address import Address
from catstream.errors import ServiceError
from catstream.web import app
from catstream.web.app import Site
from catstream.web.dashboard import Dashboard
from catstream.web.feed import PipelineFeed
from catstream.web.server import Server
from catstream.wire.channels import HEALTH, PREVIEWS, TRACKS
from catstream.wire.messages import Health
from catstream.wire.newest import Publisher

TOKEN = "correct-horse-battery"
FILES = sorted((Path(app.__file__).parent / "page").iterdir())
TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}
PATHS = ["/", "/events", "/live.mjpeg", "/pictures/1.jpg", "/metrics"]
UP = '\ncatstream_up{source=""} 1.0\n'


@pytest.fixture
def page(serve):
    return serve()


@pytest.fixture
def page_of_a_fleet(serve_fleet):
    return serve_fleet()


@pytest.fixture
def locked(serve):
    return serve(token=TOKEN)


@pytest.fixture
def pipeline(endpoint):
    """The health of all three processes, and tracks and pictures, as a pipeline sends them."""
    publishers = {name: Publisher(HEALTH, endpoint, name) for name in ("detector", "compressor", "trainer")}
    publishers |= {"tracks": Publisher(TRACKS, endpoint), "previews": Publisher(PREVIEWS, endpoint)}
    with ExitStack() as stack:
        for each in publishers.values():
            stack.enter_context(each)
        yield publishers


@pytest.fixture
def updates(page, turning):
    """A function that returns the first part of this name about a frame that the page receives."""

    def receive(name, turn):
        with turning(turn, 0.05), page.stream("GET", "/events") as events:
            for line in events.iter_lines():
                part = json.loads(line.removeprefix("data: ")).get(name) if line.startswith("data: ") else None
                if part is not None and part["frame"] is not None:
                    return part
        raise AssertionError("the stream ended")

    return receive


@pytest.mark.parametrize("kind", ["page", "page_of_a_fleet"])
def test_page_loads_nothing_from_other_hosts_and_has_no_inline_script(kind, request):
    page = request.getfixturevalue(kind)
    answer = page.get("/")
    assert answer.status_code == 200
    policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
    assert (policy["default-src"], policy["script-src"], policy["style-src"]) == ("'none'", "'self'", "'self'")
    assert policy["frame-ancestors"] == "'none'"
    assert not re.search(r"https?://|style=|<script>", answer.text)
    for file in re.findall(r'(?:src|href)="(page/[^"]+)"', answer.text):
        assert page.get(f"/{file}").status_code == 200
    for file in FILES:
        headers = page.get(f"/page/{file.name}").headers
        assert headers["content-type"].startswith(TYPES[file.suffix])
        assert headers["x-content-type-options"] == "nosniff"


def test_server_is_healthy_alone_and_ready_once_all_processes_report(page, pipeline, until):
    def report():
        for name in ("detector", "compressor", "trainer"):
            pipeline[name].send(Health(name, time.monotonic(), {"sent": 3.0}))

    assert page.get("/healthz").status_code == 200
    assert page.get("/readyz").status_code == 503
    until(lambda: page.get("/readyz").status_code == 200, report)


def test_tracks_reach_the_page_after_an_error_on_a_message(updates, pipeline, facts, until, monkeypatch, caplog):
    def fails(*_):
        monkeypatch.undo()
        raise ArithmeticError("it cannot be")

    def turn():
        pipeline["detector"].send(Health("detector", time.monotonic(), {}))
        pipeline["tracks"].send(facts.track(5))

    monkeypatch.setattr(Dashboard, "take", fails)
    until(lambda: "ArithmeticError: it cannot be" in caplog.text, turn)
    tracks = updates("tracks", turn)
    assert (tracks["frame"], tracks["time"], [one["name"] for one in tracks["objects"]]) == (5, 0.5, [""])


def test_pictures_are_subscribed_only_while_a_page_is_open(page, updates, pipeline, facts, until):
    frames = itertools.count()

    def turn():
        pipeline["detector"].send(Health("detector", time.monotonic(), {}))
        pipeline["previews"].send(facts.preview(next(frames)))

    until(lambda: UP in page.get("/metrics").text, turn)
    assert not pipeline["previews"].has_subscribers
    picture = updates("picture", turn)
    assert page.get(f"/pictures/{picture['time']}.jpg").content == facts.preview(picture["frame"]).jpeg
    until(lambda: not pipeline["previews"].has_subscribers, turn)


def test_live_picture_has_the_track_of_its_frame_drawn_in(page, pipeline, facts, turning):
    image = np.full((48, 64, 3), 128, np.uint8)
    preview = replace(facts.preview(5), jpeg=cv2.imencode(".jpg", image)[1].tobytes())

    def turn():
        pipeline["detector"].send(Health("detector", time.monotonic(), {}))
        pipeline["tracks"].send(facts.track(5))
        pipeline["previews"].send(preview)

    received = b""
    with turning(turn, 0.02), page.stream("GET", "/live.mjpeg") as live:
        assert live.headers["content-type"] == "multipart/x-mixed-replace; boundary=picture"
        for data in live.iter_bytes():
            received += data
            parts = [part.partition(b"\r\n\r\n")[2] for part in received.split(b"--picture\r\n")[1:-1]]
            shown = [cv2.imdecode(np.frombuffer(part, np.uint8), cv2.IMREAD_COLOR) for part in parts]
            if any(picture[:48].max() > 150 for picture in shown):  # the first may come before its track
                break
    assert {picture.shape[:2] for picture in shown} == {(68, 64)}, "one size, with a track and without"


@pytest.mark.parametrize("path", ["/events", "/live.mjpeg"])
def test_response_to_head_ends_and_its_client_is_no_viewer(page, path):
    assert page.head(path).status_code == 200
    assert "\ncatstream_viewers 0.0\n" in page.get("/metrics").text, "on the same connection"


def test_request_with_a_foreign_host_name_is_rejected(page):
    for host in ("evil.example", "evil.example:8000", "127.0.0.1.evil.example", "[::1"):
        assert page.get("/", headers={"Host": host}).status_code == 400, host


def test_page_of_another_origin_cannot_send_commands(page):
    for origin in ("http://evil.example", "null", "https://127.0.0.1:1"):
        assert page.post("/control", json={"verb": "pause"}, headers={"Origin": origin}).status_code == 403, origin
    assert page.post("/control", data={"verb": "pause"}).status_code == 415, "a form, without an origin header"


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("pause", "expected"),
        ('{"verb": "format"}', "expected"),
        ('{"verb": "set-box", "box": [1, 2, 0, 4]}', "expected command in JSON"),
        ('{"verb": "set-box", "object": "../anna", "box": [1, 2, 3, 4]}', "is not a name"),
        ("x" * 5000, "expected at most 4096 bytes"),
    ],
    ids=["text", "verb", "box", "name", "length"],
)
def test_invalid_command_is_rejected_before_it_is_sent(page, body, reason):
    answer = page.post("/control", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 400
    assert reason in answer.json()["reason"]


def test_command_is_answered_with_the_reason_of_its_rejection(page, pipeline, endpoint, commanded, until):
    def answer(verb, name, **more):
        response = page.post("/control", json={"verb": verb, "object": name, **more})
        return response.status_code, response.json()["reason"]

    report = Health("detector", 0.0, {})
    until(lambda: UP in page.get("/metrics").text, lambda: pipeline["detector"].send(report))
    with commanded(endpoint, lambda command: (command.object != "carl", f"about {command.object}")) as commands:
        assert answer("pause", "") == (200, "about ")
        assert answer("set-box", "carl", box=[40, 30, 48, 48]) == (409, "set-box: about carl")
        assert answer("forget", "ben") == (200, "about ben")
    assert commands == ["pause", "set-box carl", "forget ben"]


def test_without_the_token_nothing_of_the_pipeline_is_shown(locked):
    for path in PATHS:
        answer = locked.get(path)
        assert (answer.status_code, "<form" in answer.text) == (401, path == "/"), "the page asks for the token"
        assert locked.get(path, headers={"Host": "x/page/"}).status_code == 401, "a URL would begin with this header"
    assert locked.post("/control", json={"verb": "pause"}).status_code == 401
    assert [locked.get(public).status_code for public in ("/healthz", "/readyz")] == [200, 503]


@pytest.mark.parametrize("access", ["link", "header", "no token"])
def test_with_access_everything_is_shown(serve, facts, monkeypatch, access):
    monkeypatch.setattr(Dashboard, "picture", lambda *_: facts.preview(1))
    page = serve(token=None if access == "no token" else TOKEN)
    if access == "link":
        page.get(f"/?token={TOKEN}")
    elif access == "header":
        assert page.get("/metrics", headers={"Authorization": f"Bearer {TOKEN}x"}).status_code == 401
        page.headers["Authorization"] = f"Bearer {TOKEN}"
    for path in PATHS:
        with page.stream("GET", path) as answer:
            assert answer.status_code == 200, path
    assert page.post("/control", json={"verb": "format"}).status_code == 400, "it was read"


def test_link_sets_a_cookie_and_removes_the_token_from_the_url(locked):
    answer = locked.get(f"/?token={TOKEN}", headers={"X-Forwarded-Proto": "https"})
    assert "Secure" in answer.headers["set-cookie"]
    answer = locked.get(f"/?token={TOKEN}")
    assert (answer.status_code, answer.next_request.url) == (303, locked.base_url.join("/"))
    cookie = answer.headers["set-cookie"]
    assert [word in cookie for word in (TOKEN, "HttpOnly", "SameSite=lax", "Secure")] == [False, True, True, False]
    locked.cookies.clear()
    wrong = f"{cookie.partition('=')[0]}=0123; {{another program: yes}}"
    assert locked.get("/", headers={"Cookie": wrong}).status_code == 401


def test_browser_opens_two_pages_at_two_ports(serve):
    """Browsers send a cookie to all ports of a host."""
    one, other = serve(token=TOKEN), serve(token=TOKEN[::-1])
    for page, token in ((one, TOKEN), (other, TOKEN[::-1])):
        one.cookies.extract_cookies(page.get(f"/?token={token}"))
    other.cookies = one.cookies
    assert [page.get("/metrics").status_code for page in (one, other)] == [200, 200]


def test_public_address_requires_a_long_token():
    for token, why in ((None, "without VIEW_TOKEN=none"), ("secret", "the token is too short")):
        with pytest.raises(ServiceError, match=why):
            Server(Site(PipelineFeed(Address())), host="0.0.0.0", port=0, token=token)


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_server_on_all_interfaces_has_loopback_and_host_name_urls(host):
    server = Server(Site(PipelineFeed(Address())), host=host, port=0, token=TOKEN)
    with server.in_background():
        urls = [urlsplit(url) for url in server.urls]
        assert httpx.get(server.url, follow_redirects=True).status_code == 200
    assert {url.query for url in urls} == {f"token={TOKEN}"}
    assert [url.hostname for url in urls] == ["127.0.0.1", socket.gethostname().lower()]


def test_second_interrupt_does_not_cut_the_shutdown_short(monkeypatch):
    started, stopped, stops = PipelineFeed.start, PipelineFeed.stop, []

    def start(feed):
        started(feed)
        signal.raise_signal(signal.SIGINT)

    def stop(feed):
        stops.append(feed)
        return stopped(feed)

    monkeypatch.setattr(PipelineFeed, "start", start)
    monkeypatch.setattr(PipelineFeed, "stop", stop)
    site = Site(PipelineFeed(Address()))
    monkeypatch.setattr(site, "close", lambda: signal.raise_signal(signal.SIGINT))
    Server(site, port=0, token=TOKEN).run()
    assert len(stops) == 1


def test_pending_command_is_answered_at_the_end_of_the_server(folder, monkeypatch, caplog):
    begun, answered = threading.Event(), threading.Event()
    monkeypatch.setattr("catstream.web.server.SHUTDOWN_SECONDS", 1)
    monkeypatch.setattr(PipelineFeed, "execute", lambda *_, **__: begun.set() or answered.wait(500))
    server = Server(Site(PipelineFeed(Address(str(folder)))), port=0)
    with ThreadPoolExecutor(1) as pool:
        with server.in_background():
            request = pool.submit(httpx.post, f"{server.url}control", json={"verb": "pause"}, timeout=500)
            assert begun.wait(500)
        answer = request.result()
        answered.set()
    assert (answer.status_code, answer.text) == (503, "the server of this page has ended\n")
    assert "Exception" not in caplog.text


def test_stalled_viewer_is_disconnected_without_a_traceback(folder, monkeypatch, capsys, until):
    def is_stalled():
        before = len(updates)
        time.sleep(0.5)  # five updates
        return 0 < before == len(updates)

    updates = []
    monkeypatch.setattr("catstream.web.server.SHUTDOWN_SECONDS", 0.5)
    monkeypatch.setattr(Dashboard, "updates", lambda *_: updates.append(1) or {"status": "x" * (1 << 20)})
    server = Server(Site(PipelineFeed(Address(str(folder)))), port=0)
    with socket.create_connection(urlsplit(server.url).netloc.split(":")) as viewer, server.in_background():
        viewer.sendall(b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        until(is_stalled)
    assert capsys.readouterr().err == ""


def test_port_in_use_is_an_error_or_the_next_one_is_used(page):
    port = urlsplit(str(page.base_url)).port
    with pytest.raises(ServiceError, match=rf"127.0.0.1:{port} \(Address already in use\): choose another port"):
        Server(Site(PipelineFeed(Address())), port=port)
    server = Server(Site(PipelineFeed(Address())), port=port, attempts=100)
    server._socket.close()
    assert port < urlsplit(server.url).port < port + 100

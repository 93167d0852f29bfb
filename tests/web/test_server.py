"""The server: who gets in, what others may make a browser do, and what it answers."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from catstream.box import Box
from catstream.errors import ServiceError
from catstream.messages.kinds import Health
from catstream.services.core import Commanded, Frame, History
from catstream.services.core_state import Phase, Request, Rules, State
from catstream.services.desired import DesiredObject, DesiredState
from catstream.web import app
from catstream.web.app import pipeline_site
from catstream.web.dashboard import Dashboard
from catstream.web.guard import Guard
from catstream.web.server import Server
from catstream.wire.channels import CONTROL, HEALTH, PREVIEWS, TRACKS
from catstream.wire.commands import Responder
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher

TOKEN = "correct-horse-battery"
FILES = sorted((Path(app.__file__).parent / "page").iterdir())
PATHS = ["/", "/events", "/live.mjpeg", "/pictures/1.jpg", "/metrics"]


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
def pipeline(folder):
    """The health of all three processes, and tracks and pictures, as a pipeline sends them."""
    place = Endpoint.parse(str(folder))
    with ExitStack() as stack:
        health = {
            name: stack.enter_context(Publisher(HEALTH, place, name)) for name in ("detector", "compressor", "trainer")
        }
        yield {
            **health,
            "tracks": stack.enter_context(Publisher(TRACKS, place)),
            "previews": stack.enter_context(Publisher(PREVIEWS, place)),
        }


def updates(page, name, turn):
    """The first part of that name that the page is told, while turns are made; fails where none is."""
    deadline = time.monotonic() + 60

    def told():
        with page.stream("GET", "/events") as events:
            for line in events.iter_lines():
                assert time.monotonic() < deadline, f"the page was told no {name} in time"
                if line.startswith("data: ") and name in (parts := json.loads(line.removeprefix("data: "))):
                    return parts[name]
        raise AssertionError("the stream ended")

    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(told)
        while not found.done():  # whether the page has updates or not: it listens from a moment on that nobody knows
            turn()
            time.sleep(0.05)
    return found.result()


@pytest.mark.parametrize("kind", ["page", "page_of_a_fleet"])
def test_the_page_loads_nothing_from_other_hosts_and_has_no_inline_script(kind, request):
    page = request.getfixturevalue(kind)
    answer = page.get("/")
    assert answer.status_code == 200
    policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
    assert (policy["default-src"], policy["script-src"], policy["style-src"]) == ("'none'", "'self'", "'self'")
    assert policy["frame-ancestors"] == "'none'"
    assert not re.search(r"https?://|style=|<script>", answer.text)
    for file in re.findall(r'(?:src|href)="(page/[^"]+)"', answer.text):
        assert page.get(f"/{file}").status_code == 200


@pytest.mark.parametrize("name", [path.name for path in FILES if path.suffix in (".js", ".css")])
def test_each_file_of_the_page_has_its_content_type(page, name):
    answer = page.get(f"/page/{name}")
    assert answer.headers["content-type"].startswith("text/css" if name.endswith("css") else "text/javascript")
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_files_outside_the_page_folder_are_not_served(page):
    assert page.get("/page/..%2fguard.py").status_code == 404
    assert page.get("/page/%2e%2e/guard.py").status_code == 404


def test_the_server_is_healthy_alone_and_ready_with_all_processes(page, pipeline, until):
    assert page.get("/healthz").status_code == 200
    assert page.get("/readyz").status_code == 503

    def ready():
        for name in ("detector", "compressor", "trainer"):
            pipeline[name].send(Health(name, 1.0, {"sent": 3.0, "rejected": 1.0}))
        return page.get("/readyz").status_code == 200

    until(ready)
    shown = page.get("/metrics").text
    assert "\ncatstream_up 1.0\n" in shown
    assert "\ncatstream_frames_total 3.0\n" in shown
    assert '\ncatstream_rejected_messages_total{process="trainer"} 1.0\n' in shown


def test_what_is_counted_for_each_object_has_its_name_as_a_label(page, pipeline, facts, until):
    objects = {"anna": {"rows": 3.0, "bytes": 9.0, "object_leaves": 1.0}, "ben": {"rows": 4.0, "object_leaves": 2.0}}

    def shown():
        pipeline["detector"].send(facts.tracking(time.monotonic(), "anna", "ben"))
        pipeline["compressor"].send(Health("compressor", time.monotonic(), {"rows": 7.0}, objects=objects))
        trained = {"ben": {"trained": 5.0}, "forgotten": {"trained": 6.0}}
        pipeline["trainer"].send(Health("trainer", time.monotonic(), {}, objects=trained))
        metrics = page.get("/metrics").text
        return metrics if "catstream_models_trained_total{" in metrics and "catstream_rows_total{" in metrics else None

    lines = until(shown).splitlines()
    assert "catstream_objects 2.0" in lines
    assert 'catstream_score{object="anna"} 0.75' in lines
    assert 'catstream_present{object="ben"} 1.0' in lines
    assert 'catstream_model_version{object="ben"} 1.0' in lines
    assert [line for line in lines if line.startswith("catstream_rows_total")] == [
        'catstream_rows_total{object="anna"} 3.0',
        'catstream_rows_total{object="ben"} 4.0',
    ]
    assert 'catstream_tree_leaves{object="ben",tree="object"} 2.0' in lines
    assert [line for line in lines if line.startswith("catstream_models_trained_total")] == [
        'catstream_models_trained_total{object="ben"} 5.0'
    ]


def test_the_server_is_not_ready_if_one_process_is_silent(page, pipeline, until, monkeypatch):
    monkeypatch.setattr("catstream.web.dashboard.SILENCE_SECONDS", 0.5)

    def answer(*heard):
        for name in heard:
            pipeline[name].send(Health(name, time.monotonic(), {}))
        return page.get("/readyz")

    until(lambda: answer("detector", "compressor", "trainer").status_code == 200)
    until(lambda: answer("detector", "compressor").status_code == 503)
    assert answer("detector", "compressor").text == "no health report from: trainer\n"


def test_tracks_reach_the_page_when_they_are_sent(page, pipeline, facts):
    def turn():
        pipeline["detector"].send(Health("detector", time.monotonic(), {}))
        pipeline["tracks"].send(facts.track(5))

    tracks = updates(page, "tracks", turn)
    assert (tracks["frame"], tracks["time"], [one["name"] for one in tracks["objects"]]) == (5, 0.5, [""])


def test_an_error_on_a_message_does_not_end_the_feed(page, pipeline, facts, monkeypatch, caplog):
    def fails(*_):
        monkeypatch.undo()
        raise ArithmeticError("it cannot be")

    def turn():
        pipeline["detector"].send(Health("detector", time.monotonic(), {}))
        pipeline["tracks"].send(facts.track(5))

    monkeypatch.setattr(Dashboard, "take", fails)
    assert updates(page, "tracks", turn)["frame"] == 5
    assert "ArithmeticError: it cannot be" in caplog.text


def test_pictures_are_subscribed_only_while_a_page_is_open(page, pipeline, facts, until):
    frames = itertools.count()

    def turn():
        pipeline["detector"].send(Health("detector", time.monotonic(), {}))
        pipeline["previews"].send(facts.preview(next(frames)))
        return True

    until(lambda: turn() and page.get("/metrics").text.count("\ncatstream_up 1.0\n"))
    assert not pipeline["previews"].has_subscribers
    frame = updates(page, "picture", turn)["frame"]
    assert page.get(f"/pictures/{frame}.jpg").content == facts.preview(frame).jpeg
    until(lambda: turn() and not pipeline["previews"].has_subscribers)


def test_the_live_picture_has_the_track_of_its_frame_drawn_in(page, pipeline, facts):
    image = np.full((48, 64, 3), 128, np.uint8)
    preview = replace(facts.preview(5), jpeg=cv2.imencode(".jpg", image)[1].tobytes())

    def turns():
        while not seen:
            pipeline["detector"].send(Health("detector", time.monotonic(), {}))
            pipeline["tracks"].send(facts.track(5))
            pipeline["previews"].send(preview)
            time.sleep(0.02)

    seen, told = [], b""
    with ThreadPoolExecutor(1) as pool, page.stream("GET", "/live.mjpeg") as live:
        assert live.headers["content-type"] == "multipart/x-mixed-replace; boundary=picture"
        pool.submit(turns)
        for data in live.iter_bytes():
            told += data
            parts = [part.partition(b"\r\n\r\n")[2] for part in told.split(b"--picture\r\n")[1:-1]]
            shown = [cv2.imdecode(np.frombuffer(part, np.uint8), cv2.IMREAD_COLOR) for part in parts]
            if any(picture[:48].max() > 150 for picture in shown):  # the first may come before its track
                seen.append(True)
                break
    assert {picture.shape[:2] for picture in shown} == {(68, 64)}, "one size, with a track and without"


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8000", "127.0.0.1.evil.example", "[::1", ""])
def test_a_request_with_a_foreign_host_name_is_rejected(page, host):
    assert page.get("/", headers={"Host": host}).status_code in (400, 421)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1"])
def test_a_page_of_another_origin_cannot_steer(page, origin):
    answer = page.post("/control", json={"verb": "pause"}, headers={"Origin": origin})
    assert answer.status_code == 403


def test_a_form_of_another_page_cannot_steer_without_an_origin_header(page):
    assert page.post("/control", data={"verb": "pause"}).status_code == 415


@pytest.mark.parametrize(
    "command",
    [
        {"verb": "format"},
        {"verb": "set-box"},
        {"verb": "set-box", "box": [1, 2, 3]},
        {"verb": "set-box", "box": [1, 2, 3, "4"]},
        {"verb": "set-box", "box": [1, 2, 0, 4]},
        {"verb": "set-box", "box": [1, 2, 3, float("nan")]},
        {"verb": "pause", "box": [1, 2, 3, 4]},
        {"verb": "pause", "keep": "yes"},
        {"verb": "pause", "object": "anna"},
        {"verb": "forget", "object": 1},
        {"verb": "forget", "object": "no name"},
        {"verb": "forget", "object": "a" * 65},
        {"verb": "set-box", "object": "../anna", "box": [1, 2, 3, 4]},
        ["pause"],
        "x" * 5000,
    ],
    ids=repr,
)
def test_an_invalid_command_is_rejected_before_it_is_sent(page, command):
    body = json.dumps(command)
    answer = page.post("/control", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 400
    assert "expected" in answer.json()["reason"]


@pytest.mark.parametrize(
    "body",
    ["[" * 4000, '{"verb": "set-box", "box": [1, 2, 3, %s]}' % ("9" * 400), "pause"],
    ids=["deep", "many digits", "no JSON"],
)
def test_malformed_json_is_rejected_like_any_invalid_command(page, body):
    answer = page.post("/control", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 400
    assert "expected" in answer.json()["reason"]


def test_a_command_names_its_object_and_the_reason_of_a_rejected_one_is_answered(page, pipeline, folder, until):
    rules = Rules(window=8, lag_frames=8, lockstep=False, objects_most=2, context=1.0)
    boxes = {name: DesiredObject(Box(40, 30, 48, 48), begins=1) for name in ("anna", "ben")}
    core = History(State(rules, Phase.FRAME, desired=DesiredState(boxes)))
    with Responder(CONTROL, Endpoint.parse(str(folder))) as channel, ThreadPoolExecutor(1) as pool:

        def answer(verb, name, **more):
            asked = pool.submit(page.post, "/control", json={"verb": verb, "object": name, **more})
            while not asked.done():
                for command in channel.receive_all():
                    frame = [Frame(0, live=False)] if command.verb == "set-box" else []
                    for event in (Commanded(Request(command)), *frame):
                        for each in [each for action in core.handle(event)[:1] for each in action.answers]:
                            channel.answer(each)
            return asked.result().status_code, asked.result().json()["reason"]

        def attached():
            pipeline["detector"].send(Health("detector", time.monotonic(), {}))
            return "\ncatstream_up 1.0\n" in page.get("/metrics").text

        until(attached)
        assert answer("pause", "")[0] == 200
        status, reason = answer("set-box", "carl", box=[40, 30, 48, 48])
        assert (status, "3 objects are more than 2" in reason) == (409, True)
        status, reason = answer("forget", "carl")
        assert (status, "there is no object 'carl'" in reason) == (409, True)
        assert answer("forget", "ben")[0] == 200
        assert list(core.state.desired.objects) == ["anna"]


@pytest.mark.parametrize("path", PATHS)
def test_without_the_token_nothing_of_the_pipeline_is_shown(locked, path):
    answer = locked.get(path)
    assert answer.status_code == 401
    assert ("<form" in answer.text) == (path == "/"), "the page asks for the token"
    assert locked.post("/control", json={"verb": "pause"}).status_code == 401


@pytest.mark.parametrize("opened", ["by the link", "by a header", "by no token"])
def test_with_the_token_or_without_the_need_of_one_everything_is_shown(serve, facts, monkeypatch, opened):
    monkeypatch.setattr(Dashboard, "picture", lambda *_: facts.preview(1))
    page = serve(token=None if opened == "by no token" else TOKEN)
    if opened == "by the link":
        assert page.get(f"/?token={TOKEN}", follow_redirects=True).status_code == 200
    elif opened == "by a header":
        page.headers["Authorization"] = f"Bearer {TOKEN}"
    for path in PATHS:
        with page.stream("GET", path) as answer:
            assert answer.status_code == 200, path
    assert page.post("/control", json={"verb": "format"}).status_code == 400, "it is no verb, but it was read"


@pytest.mark.parametrize("path", [*PATHS, "/control"])
def test_a_host_header_that_looks_like_a_public_path_does_not_open_another_path(path):
    # An older Starlette begins an address with this header, a newer one, where that names no host, with the server.
    head = [(b"host", b"x/page/")]
    scope = {"type": "http", "method": "GET", "path": path, "query_string": b"", "headers": head}
    scope |= {"scheme": "http", "server": ("x/page/", 80), "client": ("10.0.0.7", 5000)}
    said = []

    async def inside(*_):
        raise AssertionError("it was let in")

    async def send(message):
        said.append(message)

    async def receive():
        await asyncio.Event().wait()  # nothing more comes, and nobody leaves

    asyncio.run(Guard(inside, TOKEN)(scope, receive, send))
    assert said[0]["status"] == 401


def test_health_checks_need_no_token(locked):
    assert locked.get("/healthz").status_code == 200
    assert locked.get("/readyz").status_code == 503


def test_the_token_is_accepted_as_a_header(locked):
    assert locked.get("/metrics", headers={"Authorization": f"Bearer {TOKEN}"}).status_code == 200
    assert locked.get("/metrics", headers={"Authorization": f"Bearer {TOKEN}x"}).status_code == 401


@pytest.mark.parametrize(("asked", "opened"), [("/", "/"), ("/?search=a%3Db&", "/?search=a%3Db")])
def test_the_link_sets_a_cookie_and_the_browser_does_not_show_the_token(locked, asked, opened):
    answer = locked.get(f"{asked}{'' if '?' in asked else '?'}token={TOKEN}")
    assert (answer.status_code, str(answer.next_request.url)) == (303, str(locked.base_url.join(opened)))
    kept = answer.headers["set-cookie"]
    assert TOKEN not in kept
    assert "HttpOnly" in kept
    assert "SameSite=lax" in kept
    assert "Secure" not in kept
    assert locked.get("/").status_code == 200


def test_behind_a_proxy_with_tls_the_cookie_is_sent_over_tls_only(locked):
    answer = locked.get(f"/?token={TOKEN}", headers={"X-Forwarded-Proto": "https"})
    assert "Secure" in answer.headers["set-cookie"]


def test_the_link_never_leads_to_another_host(locked):
    answer = locked.get(f"{locked.base_url}/evil.example/?token={TOKEN}")
    assert answer.status_code == 303
    assert answer.next_request.url.host == locked.base_url.host


def test_a_browser_may_open_two_pages_at_two_ports(serve):
    """Browsers send a cookie to all ports of a host."""
    one, other = serve(token=TOKEN), serve(token=TOKEN[::-1])
    for page, token in ((one, TOKEN), (other, TOKEN[::-1])):
        one.cookies.extract_cookies(page.get(f"/?token={token}"))
    other.cookies = one.cookies
    assert [page.get("/metrics").status_code for page in (one, other)] == [200, 200]


def test_a_page_whose_cookie_is_that_of_an_earlier_server_asks_for_the_token(locked):
    port = locked.base_url.port
    answer = locked.get("/", headers={"Cookie": f"catstream-{port}=0123; {{another program: yes}}"})
    assert (answer.status_code, "<form" in answer.text) == (401, True)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "::"])
def test_a_public_address_requires_a_token(host):
    with pytest.raises(ServiceError, match="without --no-token"):
        Server(pipeline_site(), host=host, port=0)


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_server_on_all_interfaces_lists_the_addresses_for_other_machines(host):
    server = Server(pipeline_site(), host=host, port=0, token=TOKEN)
    with server.in_background():
        urls = [urlsplit(url) for url in server.urls]
    assert {url.query for url in urls} == {f"token={TOKEN}"}
    assert [url.hostname for url in urls[:2]] == ["127.0.0.1", socket.gethostname().lower()]
    assert not {"0.0.0.0", "::"} & {url.hostname for url in urls}
    for url in urls[2:]:
        with socket.socket() as other:  # only what is an address of this machine can be bound
            other.bind((url.hostname, 0))


def test_a_short_token_is_an_error():
    with pytest.raises(ServiceError, match="can be guessed"):
        Server(pipeline_site(), port=0, token="secret")


def test_a_port_in_use_is_an_error(page):
    port = urlsplit(str(page.base_url)).port
    with pytest.raises(ServiceError, match=rf"127.0.0.1:{port} .* another port"):
        Server(pipeline_site(), port=port)

"""The server of a fleet's page: what it shows of a fleet whose registry answers, and who may see it."""

import asyncio
import json
import re

import cv2
import numpy as np
import pytest
from starlette.exceptions import HTTPException

from catstream.client.address import Address
from catstream.web import feed
from catstream.web.feed import FleetFeed
from catstream.wire.endpoint import Endpoint
from catstream.wire.keys import clients, create, public_key, synchronise

TOKEN = "correct-horse-battery"
PATHS = ["/", "/events", "/metrics", "/streams/cam-7/", "/streams/cam-7/events"]


@pytest.fixture
def page(serve_fleet):
    return serve_fleet()


def first_update(page, path="/events"):
    with page.stream("GET", path) as events:
        for line in events.iter_lines():
            if line.startswith("data: "):
                return json.loads(line.removeprefix("data: "))
    raise AssertionError("the stream ended")


def shown(page, until):
    """The first update of a page once the registry has answered."""
    return until(lambda: (told := first_update(page)).get("streams") and told)


def source(page):
    """The source that the page of the stream shows."""
    return first_update(page, "/streams/cam-7/events").get("status", {}).get("source")


@pytest.fixture
def keyed(fleet, keys, folder, tcp):
    """Gives the fleet keys and a port, a client, and a stream with keys of its own, of which this is the folder."""
    stream = folder / "stream"
    create(stream)
    synchronise(stream, clients(keys))
    fleet.listen, fleet.address = tcp, tcp.removeprefix("tcp://")
    fleet.keys, fleet.keys_of_client = str(keys), str(folder / "anna")
    return stream


def test_without_the_token_nothing_of_the_fleet_is_shown(fleet, serve_fleet, until):
    fleet.stream("cam-7")
    locked = serve_fleet(token=TOKEN)
    for path in PATHS:
        answer = locked.get(path)
        assert (answer.status_code, "<form" in answer.text) == (401, path.endswith("/")), "each page asks for the token"
    locked.get("/", params={"token": TOKEN})
    until(lambda: locked.get("/streams/cam-7/").status_code == 200)
    for path in PATHS:
        with locked.stream("GET", path) as answer:
            assert answer.status_code == 200


def test_the_page_of_a_stream_is_below_that_of_the_fleet(fleet, page, camera, folder, until):
    fleet.stream("cam-7", endpoint=str(folder))
    shown(page, until)
    index = page.get("/streams/cam-7", follow_redirects=True)
    assert index.url.path == "/streams/cam-7/"
    for file in re.findall(r'(?:src|href)="(page/[^"]+)"', index.text):
        assert page.get(f"/streams/cam-7/{file}").status_code == 200
    until(lambda: source(page) == "walk.mp4", camera)
    assert page.get("/streams/cam-8/").status_code == 404


def test_the_newest_picture_of_a_stream_is_received_only_while_somebody_asks(fleet, page, camera, folder, until):
    fleet.stream("cam-7", endpoint=str(folder))
    shown(page, until)
    picture = until(lambda: (got := page.get("/streams/cam-7/picture.jpg")).status_code == 200 and got, camera)
    assert picture.headers["content-type"] == "image/jpeg"
    assert cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR).shape[1] == 640
    assert page.get("/streams/cam-8/picture.jpg").status_code == 404


def test_the_page_of_a_stream_follows_it_to_another_node(fleet, page, camera_at, folder, until, monkeypatch):
    monkeypatch.setattr("catstream.web.feed.SILENCE_SECONDS", 1.0)
    for node in ("north", "south"):
        (folder / node).mkdir()
        fleet.stream("cam-7", node=node, endpoint=str(folder / node))
        turn = camera_at(Endpoint.parse(str(folder / node)), source=f"walk.mp4 at {node}")
        shown(page, until)
        until(lambda node=node: source(page) == f"walk.mp4 at {node}", turn)


def test_a_stream_with_a_key_of_its_own_is_shown_with_the_keys_of_the_client(
    fleet, keyed, serve_fleet, camera_at, until
):
    endpoint = Endpoint.parse(fleet.listen, str(keyed))
    fleet.stream("cam-7", endpoint=fleet.listen, server=public_key(keyed))
    page, turn = serve_fleet(), camera_at(endpoint)
    shown(page, until)
    until(lambda: source(page) == "walk.mp4", turn)


def test_a_fleet_that_does_not_answer_is_not_ready_and_has_no_metrics_of_streams(
    fleet, manager, serve_fleet, until, monkeypatch
):
    monkeypatch.setattr(feed, "REGISTRY_SECONDS", 1.0)
    fleet.stream("cam-7")
    page = serve_fleet()
    shown(page, until)
    assert page.get("/readyz").status_code == 200
    assert 'stream="cam-7"' in page.get("/metrics").text
    manager.close()
    until(lambda: page.get("/readyz").status_code == 503)
    assert page.get("/healthz").status_code == 200
    metrics = page.get("/metrics").text
    assert "\ncatstream_fleet_up 0.0\n" in metrics
    assert "cam-7" not in metrics
    told = first_update(page)
    assert (told["status"]["phase"], list(told["streams"])) == ("silent", ["cam-7"])


def test_pages_of_streams_are_closed_when_nobody_looks_at_them(fleet, monkeypatch):
    monkeypatch.setattr(feed, "_MAX_FEEDS", 2)
    for number in range(1, 5):
        fleet.stream(f"cam-{number}")

    async def use():
        streams = FleetFeed(Address(fleet=fleet.address))
        streams.dashboard.take(fleet.status(), 0.0)
        first = streams.pipeline("cam-1")
        with first.viewed():
            assert streams.pipeline("cam-2") is not first
            third = streams.pipeline("cam-3")  # in place of one that nobody looks at
            assert streams.pipeline("cam-1") is first
            with third.viewed(), pytest.raises(HTTPException, match="too many"):
                streams.pipeline("cam-4")
        streams.close_unused(60.0)
        assert streams.pipeline("cam-1") is first, "it was used just now"
        streams.close_unused(0.0)
        assert streams.pipeline("cam-1") is not first
        streams.close_unused(0.0)

    asyncio.run(use())


@pytest.mark.parametrize(
    ("state", "trouble", "answer"),
    [
        ("running", "", (200, "running\n")),
        (
            "failed",
            "cannot open rtsp://10.0.0.7 (connection refused)",
            (503, "failed: cannot open rtsp://10"),
        ),
        ("lost", "its source has been lost for 12 s", (503, "lost: its source has been lost for 12 s\n")),
        ("paused", "", (503, "paused\n")),
        ("starting", "", (503, "starting\n")),
    ],
)
def test_the_first_question_whether_a_stream_is_ready_is_answered(fleet, serve_fleet, state, trouble, answer):
    fleet.stream("cam-7", state=state, trouble=trouble)
    page = serve_fleet()
    ready = page.get("/streams/cam-7/readyz")
    assert (ready.status_code, ready.text[: len(answer[1])]) == answer
    assert page.get("/streams/cam-8/readyz").status_code == 404

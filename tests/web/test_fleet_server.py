"""The server of the page of a fleet, whose registry answers, is silent, or starts later."""

import asyncio
import json
import re

import cv2
import numpy as np
import pytest
from starlette.exceptions import HTTPException

from catstream.client.address import Address
from catstream.web import wall
from catstream.web.wall import Wall
from catstream.wire.endpoint import Endpoint


def status_of(page):
    return page.get("/status").json()


def source(page):
    """The source that the page of the stream shows."""
    with page.stream("GET", "/streams/cam-7/events") as events:
        for line in events.iter_lines():
            if line.startswith("data: "):
                return json.loads(line.removeprefix("data: ")).get("status", {}).get("source")
    raise AssertionError("the stream ended")


def test_newest_picture_of_a_stream_is_served(fleet, serve_fleet, camera, folder, until):
    fleet.stream("cam-7", endpoint=str(folder))
    page = serve_fleet()
    picture = until(lambda: (got := page.get("/streams/cam-7/picture.jpg")).status_code == 200 and got, camera)
    assert picture.headers["content-type"] == "image/jpeg"
    assert cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR).shape[1] == 640
    assert page.get("/streams/cam-8/picture.jpg").status_code == page.get("/streams/cam-8/").status_code == 404


def test_page_of_a_stream_follows_it_to_another_node(fleet, serve_fleet, camera_at, folder, until, monkeypatch):
    monkeypatch.setattr("catstream.web.feed.SILENCE_SECONDS", 1.0)
    fleet.stream("cam-7")
    page = serve_fleet()
    index = page.get("/streams/cam-7", follow_redirects=True)
    assert index.url.path == "/streams/cam-7/"
    for file in re.findall(r'(?:src|href)="(page/[^"]+)"', index.text):
        assert page.get(f"/streams/cam-7/{file}").status_code == 200
    for node in ("north", "south"):
        (folder / node).mkdir()
        fleet.stream("cam-7", node=node, endpoint=str(folder / node))
        turn = camera_at(Endpoint.parse(str(folder / node)), source=f"walk.mp4 at {node}")
        until(lambda node=node: source(page) == f"walk.mp4 at {node}", turn)


def test_silent_fleet_is_not_ready_and_has_no_stream_metrics(fleet, manager, serve_fleet, until, monkeypatch):
    monkeypatch.setattr(wall, "REGISTRY_SECONDS", 1.0)
    fleet.stream("cam-7")
    page = serve_fleet()
    until(lambda: page.get("/readyz").status_code == 200)
    until(lambda: 'stream="cam-7"' in page.get("/metrics").text)
    manager.close()
    until(lambda: page.get("/readyz").status_code == 503)
    assert page.get("/healthz").status_code == 200
    metrics = page.get("/metrics").text
    assert "\ncatstream_fleet_up 0.0\n" in metrics
    assert "cam-7" not in metrics
    shown = status_of(page)
    assert "no answer from the fleet" in shown["problem"]
    assert [stream["name"] for stream in shown["streams"]] == ["cam-7"], "the last state stays"


def test_page_shows_neither_address_nor_key_of_a_pipeline(fleet, serve_fleet):
    fleet.stream("cam-7", endpoint="/tmp/secret-place", server="a-public-key", token=7, models={"anna": 2})
    fleet.node("north-1", labels={"site": "north"})
    shown = status_of(serve_fleet())
    assert (shown["problem"], shown["nodes"][0]["labels"]) == ("", {"site": "north"})
    assert shown["streams"][0]["models"] == {"anna": 2}
    assert shown["streams"][0].keys() & {"endpoint", "server", "token"} == set()


def test_page_waits_for_a_fleet_that_starts_later(fleet, serve_site, managing, until):
    page = serve_site(Wall(Address(fleet=fleet.name)))
    shown = status_of(page)
    assert (shown["age"], shown["streams"]) == (None, [])
    assert "no fleet" in shown["problem"]
    fleet.stream("cam-7")
    with managing(fleet.status):
        until(lambda: [stream["name"] for stream in status_of(page)["streams"]] == ["cam-7"])


def test_pages_of_streams_are_closed_without_viewers(fleet, monkeypatch):
    monkeypatch.setattr(wall, "_MAX_SITES", 2)
    for number in range(1, 5):
        fleet.stream(f"cam-{number}")

    async def use():
        pages = Wall(Address(fleet=fleet.name))
        pages._status = fleet.status()
        first = pages.site("cam-1")
        with first.feed.viewed():
            assert pages.site("cam-2") is not first
            third = pages.site("cam-3")  # replaces cam-2, which has no viewer
            assert pages.site("cam-1") is first
            with third.feed.viewed(), pytest.raises(HTTPException, match="too many"):
                pages.site("cam-4")
        pages._close_unused(60.0)
        assert pages.site("cam-1") is first, "it was used just now"
        pages._close_unused(0.0)
        assert pages.site("cam-1") is not first
        pages._close_unused(0.0)

    asyncio.run(use())


@pytest.mark.parametrize(
    ("state", "trouble", "answer"),
    [("running", "", (200, "running\n")), ("failed", "cannot open walk.mp4", (503, "failed, cannot open walk.mp4\n"))],
)
def test_first_readiness_check_of_a_stream_is_answered(fleet, serve_fleet, state, trouble, answer):
    fleet.stream("cam-7", state=state, trouble=trouble)
    page = serve_fleet()
    ready = page.get("/streams/cam-7/readyz")
    assert (ready.status_code, ready.text) == answer
    assert page.get("/streams/cam-8/readyz").status_code == 404

"""Fixtures of the tests of the pages: messages of a pipeline, and pages that are served."""

import shutil
import time
from contextlib import ExitStack
from pathlib import Path
from uuid import uuid4

import cv2
import httpx
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.client.address import Address
from catstream.web.app import Site
from catstream.web.feed import PipelineFeed
from catstream.web.server import Server
from catstream.web.wall import Wall
from catstream.wire.channels import HEALTH, PREVIEWS
from catstream.wire.messages import FleetStatus, Health, Model, NodeStatus, Preview, StreamStatus, Track
from catstream.wire.newest import Publisher

JPEG = b"\xff\xd8\xff\xe0 a picture"


class Facts:
    """Messages about frame after frame, of one object or of several."""

    @staticmethod
    def track(frame, version=1, state="present", score=0.75, name="", began=0):
        box = None if state == "absent" else Box(4.0, 3.0, 20.0, 10.0)
        return Track(frame, frame / 10, state, box, score, version, None, name, began)

    @staticmethod
    def model(version, frame, name="", began=0):
        return Model(version, frame, np.ones(2, np.float32), 0.0, object=name, began=began)

    @staticmethod
    def preview(frame, *names):
        box = Box(4.0, 3.0, 20.0, 10.0)
        return Preview(frame, frame / 25, 64, 48, dict.fromkeys(names or ("",), box), JPEG + str(frame).encode())

    @staticmethod
    def tracking(sent, *names):
        """The health report of a detector after `sent` frames, which tracks these objects."""
        counters = {"model_version": 1.0, "score": 0.75, "present": 1.0}
        return Health("detector", 1.0, {"sent": sent, "objects": len(names)}, objects=dict.fromkeys(names, counters))


@pytest.fixture(scope="session")
def facts():
    return Facts


@pytest.fixture
def script_of_browser(tmp_path):
    """Returns the words of a command that starts a script in this folder with a browser, at a URL."""
    node, chromium, here = shutil.which("node"), shutil.which("chromium"), Path(__file__).parent
    if node is None or chromium is None or not (here / "node_modules" / "axe-core").exists():
        pytest.skip("no browser: apt-get install nodejs npm chromium, and npm ci --prefix tests/web")
    return lambda script, url, *words: [node, here / script, url, chromium, tmp_path / "profile", *words]


@pytest.fixture
def serve_site():
    """Serves sites: a client of each of them."""
    with ExitStack() as stack:

        def start(site, **options):
            server = Server(site, port=0, **options)
            stack.enter_context(server.in_background())
            return stack.enter_context(httpx.Client(base_url=server.url.partition("?")[0], timeout=500, verify=False))

        yield start


@pytest.fixture
def serve(serve_site, folder):
    """Starts pages of the pipeline in `folder`: a client of each of them."""
    return lambda **options: serve_site(Site(PipelineFeed(Address(str(folder)))), **options)


class Fleet:
    """A fleet of made-up streams and nodes, which a test changes by their names."""

    def __init__(self):
        self.name = f"fleet-{uuid4().hex[:12]}"
        self.streams, self.nodes = {}, {}

    def stream(self, name, state="running", **more):
        self.streams[name] = StreamStatus(name, state, **more)

    def node(self, name, state="alive", **more):
        self.nodes[name] = NodeStatus(name, state, **more)

    def status(self):
        return FleetStatus(self.name, time.time(), dict(self.streams), dict(self.nodes))


@pytest.fixture
def fleet():
    return Fleet()


@pytest.fixture
def manager(fleet, managing):
    """The registry of the fleet, which ends once this is closed."""
    with ExitStack() as stack:
        stack.enter_context(managing(fleet.status))
        yield stack


@pytest.fixture
def serve_fleet(serve_site, fleet, manager):  # noqa: ARG001  # it answers
    """Starts pages of the fleet: a client of each of them."""
    return lambda **options: serve_site(Wall(Address(fleet=fleet.name)), **options)


@pytest.fixture
def camera_at(rng):
    """Makes publishers of a pipeline: a function that sends the picture and the health report of the next frame."""
    image = cv2.imencode(".jpg", rng.integers(0, 255, (360, 640, 3), np.uint8))[1].tobytes()
    boxes, frame = {"anna": Box(4.0, 3.0, 200.0, 100.0)}, iter(range(1 << 30))
    with ExitStack() as stack:

        def make(endpoint, source="walk.mp4"):
            pictures = stack.enter_context(Publisher(PREVIEWS, endpoint))
            health = stack.enter_context(Publisher(HEALTH, endpoint, "detector"))

            def turn():
                number = next(frame)
                pictures.send(Preview(number, number / 25, 1280, 720, boxes, image))
                health.send(Health("detector", 1.0, {"sent": float(number)}, source=source))
                for publisher in (pictures, health):
                    publisher.serve_late_joiners()

            return turn

        yield make


@pytest.fixture
def camera(camera_at, endpoint):
    """A function that sends the next picture of a pipeline in `folder`."""
    return camera_at(endpoint)

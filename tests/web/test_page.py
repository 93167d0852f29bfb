"""The page in a real browser: objects are drawn with the mouse, one is forgotten, one is tracked after a restart."""

import subprocess
from concurrent.futures import ThreadPoolExecutor
from time import sleep

import httpx
import pytest

from catstream.base.settings import Settings
from catstream.client.address import Address
from catstream.client.attach import subscribe
from catstream.pipeline import Pipeline
from catstream.video.rendered import RATE, Demo
from catstream.video.writer import VideoWriter
from catstream.web.app import Site
from catstream.web.feed import PipelineFeed
from catstream.web.server import Server

pytestmark = pytest.mark.system

SIZE = (320, 240)
LEAVES = 475  # frame of the demo in which the object has left the picture


def test_objects_are_drawn_forgotten_and_tracked_after_a_restart(script_of_browser, folder, tmp_path, until):
    path, boxes = tmp_path / "demo.mp4", []
    with VideoWriter(path, RATE, SIZE) as video:
        for image, box in map(Demo(SIZE).image, range(LEAVES - 120, LEAVES + 25)):
            video.write(image)
            boxes.append(box)
    # The pipeline continues only if its tracks are received.
    settings = Settings(run={"endpoint": str(folder), "unstored_frames": 4})
    feed = PipelineFeed(Address(str(folder)))
    server = Server(Site(feed), port=0, token="correct-horse-battery")
    words = script_of_browser("page.mjs", server.url, ",".join(map(str, boxes[0])), str(SIZE[0]))
    output = tmp_path / "output"

    def printed(line):
        has_ended, lines = browser.poll() is not None, output.read_text().splitlines()
        assert line in lines or not has_ended, lines
        return line in lines

    with (
        server.in_background(),
        output.open("w") as file,
        subprocess.Popen(words, stdin=subprocess.PIPE, stdout=file, text=True) as browser,
    ):
        with Pipeline(str(path), None, settings) as pipeline:
            waits = {"present": 20, "absent": 5}  # how many frames of a state there are before the page is looked at
            for track in pipeline:
                if not track.object and track.state in waits:
                    waits[track.state] -= 1
                    if not waits[track.state]:
                        line = {"present": "paused", "absent": "state absent"}[track.state]
                        until(lambda line=line: printed(line))
                        del waits[track.state]
                if not waits:
                    break
            until(lambda: printed("trees"))
        until(lambda: printed("state ended"))
        with Pipeline(str(path), boxes[0], settings) as pipeline:
            browser.stdin.write("restart\n")
            browser.stdin.flush()
            until(lambda: feed.dashboard.phase == "running")
            for _ in pipeline:
                if printed("errors []"):
                    break
                sleep(0.5)  # the page shows the next frames
    lines = output.read_text().splitlines()
    assert lines[0] == "state waiting for a box"
    assert "refused 'no name' is not a name: expected" in "\n".join(lines)
    assert "objects object without a name,object-2" in lines
    assert "forgotten object-2 is no longer tracked after frame N" in lines
    assert lines.count("state present") == 2, "before and after the restart"
    assert "overflow 0" in lines


def test_object_of_a_camera_is_tracked_from_its_still_picture(script_of_browser, folder, walker):
    url, find = walker
    server = Server(Site(PipelineFeed(Address(str(folder)))), port=0, token=None)
    words = script_of_browser("live.mjs", server.url, "1")
    with (
        server.in_background(),
        ThreadPoolExecutor(1) as pool,
        Pipeline(url, settings={"run.endpoint": str(folder)}) as pipeline,
        subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as browser,
    ):
        pool.submit(list, pipeline)  # until it is closed
        _, time = browser.stdout.readline().split()
        box = find(httpx.get(f"{server.url}pictures/{time}.jpg").content)
        browser.stdin.write(",".join(map(str, box)) + "\n")
        browser.stdin.flush()
        assert browser.stdout.readline() == "still true\n"
        assert " s before frame 0" in browser.stdout.readline()
        assert browser.stdout.readline() == "errors []\n"
        with subscribe(str(folder), "previews", timeout=500) as pictures:
            picture = next(pictures)
        assert picture.boxes[""].overlap(find(picture.jpeg)) > 0.5

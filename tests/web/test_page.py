"""The page in a real browser: objects are drawn with the mouse, one is forgotten, one is tracked after a restart."""

from __future__ import annotations

import os
import signal
import subprocess
import threading

import pytest

from catstream.pipeline import Pipeline
from catstream.settings import Settings
from catstream.video.demo import RATE, render
from catstream.video.writer import VideoWriter
from catstream.web.app import pipeline_site
from catstream.web.server import Server

pytestmark = pytest.mark.system

SIZE = (320, 240)
LEAVES = 475  # frame of the demo in which the object has left the picture


@pytest.fixture
def browse(script_of_browser):
    """Starts a browser that does what `page.mjs` says; the lines that it prints, and where to write to it."""
    browsers = []

    def start(url, box):
        browser = subprocess.Popen(
            script_of_browser("page.mjs", url, ",".join(map(str, box)), str(SIZE[0])),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        browsers.append(browser)
        lines = []
        reader = threading.Thread(target=lambda: lines.extend(line.strip() for line in browser.stdout))
        reader.start()
        browsers.append(reader)
        return browser, lines

    yield start
    if browsers:
        browser, reader = browsers
        browser.stdin.close()
        try:
            browser.wait(30)
        except subprocess.TimeoutExpired:
            browser.kill()
            browser.wait()
        reader.join()
        browser.stdout.close()


def test_objects_are_drawn_and_forgotten_and_one_is_tracked_until_it_leaves_and_after_a_restart(
    browse, folder, tmp_path, until
):
    path, boxes = tmp_path / "demo.mp4", []
    with VideoWriter(path, RATE, SIZE) as video:
        for image, box in render(145, SIZE, begin=LEAVES - 120):
            video.write(image)
            boxes.append(box)
    # The pipeline continues only if its tracks are received.
    settings = Settings(run={"endpoint": str(folder), "unstored_frames": 4})
    server = Server(pipeline_site(str(folder)), port=0, token="correct-horse-battery")
    with server.in_background():
        with Pipeline(str(path), None, settings) as pipeline:
            browser, lines = browse(server.url, boxes[0])

            def said(line):
                assert browser.poll() is None or line in lines, lines
                return line in lines

            waits = {"present": 20, "absent": 5}  # how many frames of a state there are before the page is looked at
            for track in pipeline:
                if not track.object and track.state in waits:
                    waits[track.state] -= 1
                    if not waits[track.state]:
                        seen = {"present": "paused", "absent": "state absent"}[track.state]
                        until(lambda seen=seen: said(seen))
                        del waits[track.state]
                if not waits:
                    break
            until(lambda: said("kill"))
            for pid in pipeline.pids.values():
                os.kill(pid, signal.SIGKILL)
            until(lambda: said("state pipeline silent"))
        until(lambda: said("state ended"))
        with Pipeline(str(path), boxes[0], settings) as pipeline:
            browser.stdin.write("restart\n")
            browser.stdin.flush()
            seen = lines.index("state ended") + 1
            for number, track in enumerate(pipeline):
                if track.state == "present" and number > 5:
                    until(lambda: "state present" in lines[seen:] and said("errors []"))
                    break
    assert lines[0] == "state waiting for a box"
    assert "refused command object: 'no name' is not a name: expected" in "\n".join(lines)
    assert "objects object without a name,object-2" in lines
    assert "forgotten object-2 is no longer tracked after frame N" in lines
    assert "surprising true" in lines
    assert "overflow 0" in lines

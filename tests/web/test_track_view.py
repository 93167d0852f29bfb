"""`catstream track --view`: the page of a run, its first box, and its metrics."""

from __future__ import annotations

import json
import re
from pathlib import Path

import httpx

BOARD = Path(__file__).parents[2] / "docs" / "grafana.json"
#: A counter of a live source, and those of a run that tracks.
OTHERS = {"catstream_detector_skipped", "catstream_detector_present", "catstream_detector_score"}


def test_the_first_box_can_come_from_the_page_which_shows_the_end_of_the_run_and_of_the_server(
    demo_video, catstream, folder, tmp_path, until
):
    source, boxes = demo_video(40)
    words = ["track", source, "--output", tmp_path / "out", "--set", f"run.endpoint={folder}"]
    page = ["--view", "127.0.0.1:0"]
    run = catstream(*words, *page)
    with httpx.Client(timeout=60, verify=False) as browser:
        said = run.stderr.readline()
        assert said.startswith("page: http://127.0.0.1:")
        link = said.split()[1]
        url = link.partition("?")[0]
        assert browser.get(url).status_code == 401, "there is a token by default"
        browser.get(link)
        until(lambda: browser.get(f"{url}readyz").text == "waiting for a box\n")
        told = {}
        with browser.stream("GET", f"{url}events") as events:
            lines = events.iter_lines()
            next(lines)
            command = {"verb": "set-box", "box": list(boxes[0])}
            answer = until(lambda: browser.post(f"{url}control", json=command))
            assert answer.json()["done"], answer.text
            browser.post(f"{url}control", json={"verb": "pause"})
            asked = set(re.findall(r"(catstream_\w+){", BOARD.read_text())) - OTHERS
            until(lambda: asked <= set(re.findall(r"catstream_\w+", browser.get(f"{url}metrics").text)))
            browser.post(f"{url}control", json={"verb": "resume"})
            for line in lines:
                told |= json.loads(line.removeprefix("data: ")) if line.startswith("data: ") else {}
        run.communicate(timeout=120)
    assert (told["status"]["phase"], told["status"]["source"], told["closed"]) == ("ended", str(source), True)
    assert told["tracks"]["frame"] == 39
    assert run.returncode == 0
    assert len((tmp_path / "out" / "demo.ndjson").read_text().splitlines()) == 40

"""`catstream view`, `catstream fleet view` and `catstream track --view`, as a user starts them."""

import encodings.idna  # noqa: F401  # imported before the user changes, who may not read this installation
import json
import os
import re
from contextlib import contextmanager
from pathlib import Path

import click
import httpx
import pytest

from catstream.cli.view import HostPortType, token_of_page

PATHS = ["/", "/events", "/live.mjpeg", "/pictures/1.jpg", "/metrics", "/streams/roof/", "/streams/roof/events"]


@contextmanager
def another_user():
    """Run as another user of the machine if this one is root; without the token, a server cannot tell them apart."""
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)


@pytest.mark.parametrize("words", [("view", "--listen", "127.0.0.1:0"), ("fleet", "view", "--listen", "127.0.0.1:0")])
def test_other_users_of_the_machine_are_denied_all_but_health_checks(catstream, words):
    process = catstream(*words, env=os.environ | {"PYTHONUNBUFFERED": "1"})
    link = process.stdout.readline().strip()
    url, _, token = link.partition("?token=")
    assert len(token) == 32
    with another_user(), httpx.Client(base_url=url, verify=False) as stranger:
        assert {path: stranger.get(path).status_code for path in PATHS} == dict.fromkeys(PATHS, 401)
        for place in ("/control", "/streams/roof/control"):
            assert stranger.post(place, json={"verb": "pause"}).status_code == 401
        assert stranger.get("/healthz").status_code == 200
        assert token not in Path(f"/proc/{process.pid}/cmdline").read_text(), "every user can read it"
    with httpx.Client(verify=False, follow_redirects=True) as owner:
        page = owner.get(link)
        assert (page.status_code, str(page.url), "<main" in page.text) == (200, url, True)
        assert owner.get(f"{url}metrics").status_code == 200
    process.terminate()
    assert process.wait(500) == 0


@pytest.mark.parametrize("text", ["", "x", "host:", "8000:host", "70000", "-1"])
def test_malformed_address_is_an_error(text):
    with pytest.raises(click.BadParameter, match="for example 8000"):
        HostPortType().convert(text, None, None)


def test_token_is_from_the_variable_or_the_file_of_the_user(tmp_path, monkeypatch):
    def token(variable=""):
        monkeypatch.setenv("VIEW_TOKEN", variable)
        return token_of_page()

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    file = tmp_path / "catstream" / "view-token"
    made = [token(), token()]
    assert re.fullmatch(r"[0-9a-f]{32}", made[0])
    assert made == [made[0], file.read_text().strip()]
    assert file.stat().st_mode & 0o777 == 0o600
    file.chmod(0o644)
    assert token() != made[0], "others may have read it"
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null")
    assert token() != token(), "it cannot be stored"
    assert token("none") is None
    assert token("from-a-variable-1") == "from-a-variable-1"


BOARD = Path(__file__).parents[2] / "docs" / "grafana.json"
#: A counter of a live source, and those of a run that tracks.
OTHERS = {"catstream_detector_skipped_total", "catstream_detector_present", "catstream_detector_score"}


def test_page_sets_the_initial_box_and_shows_the_end_of_the_run(demo_video, catstream, folder, tmp_path, until):
    source, boxes = demo_video(40)
    words = ["track", source, "--output", tmp_path / "out", "--set", f"run.endpoint={folder}"]
    run = catstream(*words, "--view", "127.0.0.1:0")
    with httpx.Client(timeout=500, verify=False) as browser:
        link = run.stderr.readline().removeprefix("page: ").strip()
        url = link.partition("?")[0]
        assert browser.get(url).status_code == 401, "there is a token by default"
        browser.get(link)
        until(lambda: browser.get(f"{url}readyz").text == "waiting for a box\n")
        shown = {}
        with browser.stream("GET", f"{url}events") as events:
            lines = events.iter_lines()
            next(lines)
            browser.post(f"{url}control", json={"verb": "pause"})  # before the box: the video is short
            command = {"verb": "set-box", "box": list(boxes[0])}
            answer = until(lambda: browser.post(f"{url}control", json=command))
            assert answer.json()["done"], answer.text
            asked = set(re.findall(r"(catstream_\w+){", BOARD.read_text())) - OTHERS
            until(lambda: asked <= set(re.findall(r"catstream_\w+", browser.get(f"{url}metrics").text)))
            browser.post(f"{url}control", json={"verb": "resume"})
            for line in lines:
                shown |= json.loads(line.removeprefix("data: ")) if line.startswith("data: ") else {}
        run.communicate(timeout=500)
    assert (shown["status"]["phase"], shown["status"]["source"], shown["closed"]) == ("ended", str(source), True)
    assert shown["tracks"]["frame"] == 39
    assert run.returncode == 0
    assert len((tmp_path / "out" / "demo.ndjson").read_text().splitlines()) == 1 + 40

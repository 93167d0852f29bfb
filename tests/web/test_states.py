"""The page in each of its states, in a real browser: readable for all, and telling what is so."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from catstream.web.server import Server

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """What `states.mjs` saw, by colour scheme and state."""
    node, chromium = shutil.which("node"), shutil.which("chromium")
    if node is None or chromium is None or not (HERE / "node_modules" / "axe-core").exists():
        pytest.skip("no browser: apt-get install nodejs npm chromium, and npm ci --prefix tests/web")
    folder = tmp_path_factory.mktemp("page")
    cv2.imwrite(str(folder / "picture.jpg"), np.full((240, 320, 3), (200, 160, 90), np.uint8))
    server = Server(str(folder / "nowhere"), port=0)
    with server.beside():
        words = [node, HERE / "states.mjs", server.url, chromium, folder / "profile", folder / "picture.jpg"]
        run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert run.stdout, run.stderr
    return {(state["scheme"], state["state"]): state for state in json.loads(run.stdout)}


def test_axe_finds_nothing_wrong_with_any_state(seen):
    assert len(seen) == 28
    assert {key: state["violations"] for key, state in seen.items() if state["violations"]} == {}
    assert {key for key, state in seen.items() if state["wide"] > 0} == set(), "wider than its window"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_names_the_source_and_not_the_folder_of_the_pipeline(seen, scheme):
    assert seen[scheme, "present"]["about"] == "walk.mp4"
    assert seen[scheme, "lost"]["about"] == "walk.mp4, 40 frames skipped"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_after_the_end_the_page_keeps_what_it_showed_and_says_that_its_server_ended_too(seen, scheme):
    before, last = seen[scheme, "the end"], seen[scheme, "the end, and of the server"]
    assert before["veil"] == "The end: the source came to its end. This page waits for the next one."
    assert last["veil"].startswith("The end: the source came to its end. The server of this page has ended too")
    assert (last["pill"], last["frame"], last["shots"], last["trees"]) == ("ended", before["frame"], 3, before["trees"])


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_shows_nothing_of_a_pipeline_once_another_one_is_there(seen, scheme):
    state = seen[scheme, "another pipeline"]
    assert (state["pill"], state["about"], state["frame"]) == ("waiting", "rtsp://10.0.0.7/stream1", "")
    assert (state["veil"], state["shots"], set(state["trees"])) == ("Waiting for a picture", 0, {"no leaf yet"})

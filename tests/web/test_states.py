"""The page in each of its states, in a real browser: accessible and correct."""

import json
import subprocess

import cv2
import numpy as np
import pytest

from catstream.client.address import Address
from catstream.web.app import Site
from catstream.web.feed import PipelineFeed
from catstream.web.server import Server

pytestmark = pytest.mark.system

RESUMED = {"verb": "pause", "seconds": 0}
SEVERAL = ("three objects", "another one chosen", "drawing one more", "forgetting", "forgotten", "two objects")


@pytest.fixture
def seen(script_of_browser, tmp_path):
    """The observations of `states.mjs`, by colour scheme and state."""
    cv2.imwrite(str(tmp_path / "picture.jpg"), np.full((240, 320, 3), (200, 160, 90), np.uint8))
    server = Server(Site(PipelineFeed(Address(str(tmp_path / "nowhere")))), port=0, token="correct-horse-battery")
    with server.in_background():
        words = script_of_browser("states.mjs", server.url, tmp_path / "picture.jpg")
        run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert run.stdout, run.stderr
    return {(state["scheme"], state["state"]): state for state in json.loads(run.stdout)}


def test_each_state_of_the_page_is_accessible_and_correct(seen):
    assert len(seen) == 44
    assert {key: state["violations"] for key, state in seen.items() if state["violations"]} == {}, "found by axe"
    assert {key for key, state in seen.items() if state["wide"] > 0} == set(), "wider than its window"
    wide, phone = seen["light", "present"], seen["dark", "present"]
    assert [(state["keys"], state["folded"]) for state in (wide, phone)] == [(True, True), (False, True)]
    for scheme in ("light", "dark"):
        assert seen[scheme, "present"]["source"] == "walk.mp4"
        assert seen[scheme, "lost"]["source"] == "walk.mp4, 40 frames skipped"
        assert seen[scheme, "present"]["loud"] == [], "all is well"
        assert {tuple(seen[scheme, name]["loud"]) for name in ("waiting for a box", "absent")} == {("Draw a box",)}
        held = {"waiting for a box": "waiting for a box", "paused": "paused", "lost": "source lost for 12 s"}
        assert {name: seen[scheme, name]["pill"] for name in held} == held
        assert seen[scheme, "lost"]["overlay"] == "Source lost for 12 s: this is the last picture."
        assert seen[scheme, "lost, of several"]["scores"] == ["–", "–"]
        pictures = [seen[scheme, name]["loaded"] for name in ("waiting for a box", "bootstrapping", "present")]
        assert pictures == sorted(set(pictures)), "the frames of a paused live source have one number"
        assert seen[scheme, "three objects"]["header"].startswith("2 of 3 present"), "the state is first"
        assert len(seen[scheme, "three objects"]["lines"]) == 1, "colours are those of objects"
        assert [seen[scheme, name]["role"] for name in ("drawing one more", "drawing")] == ["new", "new"]
        assert seen[scheme, "cancelled, begun and cancelled"]["sent"] == RESUMED
        assert seen[scheme, "cancelled during a pause"]["sent"] == RESUMED, "only the pause of this page"
        check_several(*(seen[scheme, name] for name in SEVERAL))
        check_another_pipeline(seen[scheme, "another pipeline"])
        check_end(seen[scheme, "the end"], seen[scheme, "the end, and of the server"])


def check_several(three, chosen, drawing, forgetting, forgotten, two):
    """One of several objects is chosen, for the charts; a new one gets the next name; one is dropped once confirmed."""
    assert (three["pill"], three["objects"][:2]) == ("2 of 3 present", ["anna", "constructor"])
    assert three["chosen"] == ["anna"]
    assert three["charts"] == "The last two minutes of anna"
    assert chosen["charts"] == "The last two minutes of constructor"
    assert (drawing["name"], drawing["sent"]) == ("object-4", {"verb": "pause", "seconds": 30})
    assert forgetting["name"] == "dora", "as it was typed"
    assert forgetting["sent"] == RESUMED, "nothing is dropped before it is confirmed"
    assert forgotten["sent"] == {"verb": "forget", "object": "constructor"}
    assert (len(two["objects"]), two["chosen"]) == (2, ["anna"])


def check_another_pipeline(state):
    """Nothing of the pipeline before is shown."""
    assert (state["pill"], state["source"], state["frame"]) == ("waiting", "rtsp://10.0.0.7/stream1", "")
    assert (state["overlay"], set(state["trees"])) == ("Waiting for a picture", {"no leaf yet"})


def check_end(before, last):
    """The page shows its last content, and states that its server has ended."""
    assert before["overlay"] == "The end: the source has ended. This page waits for the next pipeline."
    assert last["overlay"].startswith("The end: the source has ended. The server of this page has ended too")
    assert (last["pill"], last["frame"], last["trees"]) == ("ended", before["frame"], before["trees"])

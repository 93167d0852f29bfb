"""The page of a fleet in a real browser: trouble first, the page of a stream and back, and a silent fleet."""

import json
import subprocess

import pytest

from catstream.web import wall

pytestmark = pytest.mark.system

TOKEN = "correct-horse-battery"


def test_stream_is_opened_and_a_silent_fleet_keeps_its_last_state(
    fleet, manager, serve_fleet, camera, turning, folder, script_of_browser, monkeypatch
):
    monkeypatch.setattr(wall, "REGISTRY_SECONDS", 1.0)
    objects = {"anna": True, "ben": False}
    fleet.node("north", cores=4.0, used=1.5, labels={"site": "north"}, streams=1)
    fleet.node("south-2", cores=4.0)
    fleet.node("south", "dead", cores=4.0)
    fleet.stream("cam-7", node="north", endpoint=str(folder), models={"anna": 3}, frame=25, present=objects)
    fleet.stream("cam-10", "moving", node="south")
    fleet.stream("cam-9", "failed", trouble="cam-9 needs a node with site=west, there is none")
    fleet.stream("dock", "waiting", node="south-2")
    link = str(serve_fleet(token=TOKEN).base_url.copy_set_param("token", TOKEN))
    printed = {}
    words = script_of_browser("fleet.mjs", link)
    with turning(camera, 0.02), subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as browser:
        for line in browser.stdout:
            name, *values = json.loads(line)
            printed.setdefault(name, []).extend(values)
            if name == "silence":
                manager.close()
    assert printed["all"] == [["cam-9", "cam-7", "cam-10", "dock"]]
    assert printed["wall"] == [["anna present", "ben absent"]]
    assert printed["picture"] == [True]
    assert [[text.split("\n")[0] for text in texts] for texts in printed["nodes"]] == [["south", "north", "south-2"]]
    assert printed["page"] == [["/streams/cam-7/", "cam-7 – catstream"]]
    assert printed["back"] == printed["fleet"] == printed["all"]
    assert printed["silent"][0].startswith("The fleet does not answer. This page shows the state of ")
    assert [each for each in printed["violations"] if each] == [], "found by axe"
    assert set(printed["too wide"]) == {0}
    assert printed["errors"] == [[]]

"""The server of `catstream annotate`: its state, pictures of frames, changes, and rejections."""

import json

import cv2
import numpy as np
import pytest

from catstream.offline.annotation import Annotation
from catstream.offline.session import Session, Sessions
from catstream.web import annotator as module
from catstream.web.annotator import AnnotationSite

FRAMES = 12


@pytest.fixture(scope="module")
def demo(demo_video):
    return demo_video(FRAMES)


@pytest.fixture
def sessions(demo, until):
    """Two videos, which are the same; the first one is open."""

    def session(_):
        return Session(Annotation(demo[0], {}, jobs=2), 1, lambda: None, lambda: None)

    with Sessions(["walk", "run"], session, [0.0, 0.5]) as videos:
        until(lambda: videos.current.decoded)
        yield videos


@pytest.fixture
def session(sessions):
    return sessions.current


@pytest.fixture
def page(sessions, serve_site):
    return serve_site(AnnotationSite(sessions))


@pytest.fixture
def edit(page):
    def change(verb, **fields):
        answer = page.post("/edit", json={"server": state(page)["server"], "verb": verb, **fields})
        result = answer.json()
        result.pop("revision", None)
        return answer.status_code, result

    return change


def state(page):
    with page.stream("GET", "/events") as events:
        return json.loads(next(line for line in events.iter_lines() if line).removeprefix("data: "))


def test_picture_of_a_frame_is_that_of_the_video(page, session):
    picture = cv2.imdecode(np.frombuffer(page.get("/frames/7.jpg").content, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(picture.astype(float) - session.annotation.frames[7]).mean() < 5
    assert page.get(f"/frames/{FRAMES}.jpg").status_code == page.get(f"/frames/{FRAMES}").status_code == 404


def test_each_verb_of_an_edit_changes_the_session(page, edit, demo, session):
    assert edit("draw", object="anna", frame=0, box=[*demo[1][0]]) == (200, {"done": True})
    assert edit("draw", object="anna", frame=10, box="hidden") == (200, {"done": True})
    assert page.get("/frames/10").json()["objects"]["anna"]["checked"] == "hidden"
    assert edit("undo") == (200, {"done": True, "object": "anna", "frame": 10})
    edit("draw", object="anna", frame=11)
    edit("rename", object="anna", name="ben")
    (ben,) = state(page)["objects"]
    assert (ben["name"], ben["keyframes"]) == ("ben", [0, 11])
    absent = {"box": None, "checked": "keyframe", "proposals": [None, None]}
    assert page.get("/frames/11").json()["objects"] == {"ben": absent}
    edit("delete", object="ben")
    assert state(page)["objects"] == []
    edit("done")
    assert session.finished.is_set()


def test_unchecked_frame_has_the_proposals_of_both_directions(page, edit, demo, session, until):
    edit("draw", object="anna", frame=0, box=[*demo[1][0]])
    edit("draw", object="anna", frame=11, box=[*demo[1][0].centred(60, 60)])  # a wrong box
    until(lambda: not session.remaining())
    (anna,) = state(page)["objects"]
    assert anna["unchecked"]
    forward, backward = page.get("/frames/6").json()["objects"]["anna"]["proposals"]
    assert forward != backward
    assert [frame for frame, name, _ in state(page)["next"]] != []


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"object": "anna", "frame": 0, "box": [900, 2, 30, 40]}, "outside the frame"),
        ({"object": "anna", "frame": 99, "box": [9, 2, 30, 40]}, "frame 99 is outside the video"),
        ({"object": "anna", "frame": 0}, "anna has no box"),
        ({"object": "anna", "frame": 0, "box": [9, 2, 30]}, "expected edit in JSON"),
    ],
)
def test_invalid_change_is_rejected_with_the_reason(edit, session, fields, reason):
    code, answer = edit("draw", **fields)
    assert (code, answer["done"]) == (400, False)
    assert reason in answer["reason"]
    assert session.annotation.keyframes == {}


def test_only_the_open_video_is_shown_and_changed(page, edit, sessions, demo, until):
    box = [*demo[1][0]]
    edit("draw", object="anna", frame=0, box=box)
    until(lambda: sessions.current.annotation.passes("anna"))
    passes, revision = sessions.current.annotation.passes("anna"), state(page)["revision"]
    assert edit("open", video=1) == (200, {"done": True})
    assert edit("draw", object="ben", frame=0, box=box)[0] == 409
    assert page.get("/frames/0").status_code == 404
    until(lambda: page.get("/frames/0.jpg?video=1").status_code == 200)
    now = state(page)
    assert (now["video"], now["videos"], now["objects"]) == (1, [["walk", pytest.approx(1 / FRAMES)], ["run", 0.5]], [])
    assert now["revision"] > revision
    assert edit("draw", object="ben", frame=0, box=box, video=1)[0] == 200
    edit("open", video=0)
    assert sessions.current.annotation.passes("anna") == passes
    assert edit("undo") == (200, {"done": True, "object": "anna", "frame": 0})


def test_tab_of_an_earlier_server_changes_nothing(session, sessions, serve_site, demo):
    earlier, page = serve_site(AnnotationSite(sessions)), serve_site(AnnotationSite(sessions))
    fields = {"server": state(earlier)["server"], "verb": "draw", "object": "anna", "frame": 0, "box": [*demo[1][0]]}
    answer = page.post("/edit", json=fields)
    assert (answer.status_code, answer.json()["reason"]) == (409, "this page belongs to an earlier command: reload it")
    assert session.annotation.keyframes == {}
    assert earlier.post("/edit", json=fields).status_code == 200


def test_interrupted_command_continues_from_its_boxes(said, demo, tmp_path, monkeypatch, until):
    def annotate(frame, interrupted):
        def draw(sessions, _):
            until(lambda: sessions.current.decoded)
            sessions.current.draw("anna", frame, demo[1][frame])
            return interrupted

        monkeypatch.setattr("catstream.cli.annotate.serve", draw)
        return said("annotate", demo[0], "--output", tmp_path / "out", "--jobs", 1)

    code, _, errors = annotate(0, interrupted=True)
    assert (code, "the same command continues" in errors) == (130, True)
    assert (tmp_path / "out" / "demo.ndjson").exists()
    code, output, _ = annotate(FRAMES - 1, interrupted=False)
    assert (code, "2 keyframes" in output) == (0, True)


def test_only_changes_are_sent_and_timelines_are_bounded(session, edit, page, demo, until, monkeypatch):
    monkeypatch.setattr(module, "_PARTS", 5)
    assert module._runs(np.array([True] * 3 + [False] * 9 + [True] * 11)) == [(0, 4), (10, 22)]
    edit("draw", object="anna", frame=0, box=[*demo[1][0]])
    until(lambda: not session.remaining())
    with page.stream("GET", "/events") as events:
        states = (json.loads(line.removeprefix("data: ")) for line in events.iter_lines() if line.startswith("data: "))
        assert next(states)["objects"][0]["wrong"] == len(demo[1]) - 1
        session.rename("anna", "ben")
        assert {"server", "video", "frames"}.isdisjoint(next(states))

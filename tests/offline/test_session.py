"""A session: changes are saved at once, tracked in the background, and undone."""

import shutil
from concurrent.futures import Future
from pathlib import Path

import pytest

from catstream.base.box import Box
from catstream.errors import BoxError, CommandRejectedError, ObjectError, ServiceError, VideoError
from catstream.offline import session as module
from catstream.offline.annotation import Annotation
from catstream.offline.passes import PAUSED
from catstream.offline.session import Session
from catstream.video.video_frames import VideoFrames

FRAMES = 24


@pytest.fixture(scope="module")
def demo(demo_video):
    return demo_video(FRAMES)


@pytest.fixture
def saved():
    return []


@pytest.fixture
def session(demo, saved, until):
    annotation = Annotation(demo[0], {}, jobs=2)
    with annotation, Session(annotation, 1, lambda: saved.append(annotation.keyframes), lambda: None) as one:
        until(lambda: one.decoded)
        yield one


def test_boxes_are_saved_and_tracked_until_all_frames_are_checked(session, saved, demo, until):
    truth = demo[1]
    session.draw("anna", 0, truth[0])
    until(lambda: [each.frame for each in session.next_frames] == [FRAMES - 1])
    session.draw("anna", FRAMES - 1, truth[-1])
    assert saved[-1] == {"anna": {0: truth[0], FRAMES - 1: truth[-1]}}
    until(lambda: session.remaining() == 0 and not session.next_frames)
    assert {track.checked for track in session.tracks["anna"]} == {"keyframe", "checked"}


def test_frames_remain_as_soon_as_a_box_is_drawn(session, demo, until):
    until(lambda: not session.remaining())
    with session.lock:  # its thread cannot look for the missing passes
        session.draw("anna", 0, demo[1][0])
        assert session.remaining()


def test_undo_restores_the_earlier_box_and_its_passes(session, saved, demo, until):
    truth = demo[1]
    session.draw("anna", 0, truth[0])
    until(lambda: session.annotation.passes("anna"))
    before = session.annotation.passes("anna")
    session.draw("anna", 0, truth[0].centred(60, 60))
    assert session.annotation.passes("anna") == []
    assert session.undo() == ("anna", 0)
    assert session.annotation.passes("anna") == before
    assert session.undo() == ("anna", 0)
    assert saved[-1] == {}
    assert session.undo() is None


def test_renamed_object_keeps_its_passes(session, demo, until):
    session.draw("anna", 0, demo[1][0])
    until(lambda: session.annotation.passes("anna"))
    session.rename("anna", "ben")
    assert session.annotation.passes("ben")
    session.draw("carl", 3, demo[1][0])
    with pytest.raises(ObjectError, match="there is an object carl already"):
        session.rename("ben", "carl")
    session.rename("ben", "ben")
    assert session.undo() == ("carl", 3)
    assert session.undo() == ("anna", None)
    assert session.annotation.keyframes == {"anna": {0: demo[1][0]}}


def test_undo_restores_a_deleted_box_or_object(session, saved, demo):
    first, last = demo[1][0], demo[1][-1]
    for name, frame, box in (("anna", 0, first), ("anna", 9, None), ("anna", FRAMES - 1, last), ("ben", 0, first)):
        session.draw(name, frame, box)
    drawn = [saved[-1]]
    for deleted in (("anna", 5), ("anna", 0), ("anna", FRAMES - 1), ("ben",)):
        session.delete(*deleted)
        drawn.append(saved[-1])
    assert drawn[1:] == [
        drawn[0],
        {"anna": {9: None, FRAMES - 1: last}, "ben": {0: first}},
        {"ben": {0: first}},  # an absence alone teaches nothing
        {},
    ]
    assert [session.undo() for _ in range(3)] == [("ben", None), ("anna", FRAMES - 1), ("anna", 0)]
    assert saved[-1] == drawn[0]


def test_finished_session_rejects_changes(session, saved, demo):
    session.draw("anna", 0, demo[1][0])
    session.finish()
    with pytest.raises(CommandRejectedError):
        session.rename("anna", "ben")
    assert [*saved[-1]] == ["anna"]


def test_new_box_stops_the_passes_of_the_replaced_one(session, demo, until, monkeypatch):
    monkeypatch.setattr(module, "_LONG", 0)
    session.draw("anna", 0, demo[1][0].centred(60, 60))
    until(lambda: session.remaining() > 1 or session.annotation.passes("anna"))
    session.draw("anna", 0, demo[1][0])
    until(lambda: session.annotation.passes("anna") and not session.remaining())
    assert session.tracks["anna"][5].box.overlap(demo[1][5]) > 0.5
    assert len(session.annotation.passes("anna")) == 1


def test_objects_take_turns(demo, until, monkeypatch):
    drawn = {
        name: {frame: demo[1][frame]._replace(x=10 + step) for frame in (0, 8, 16)}
        for step, name in enumerate(("anna", "ben"))
    }
    order = []
    with Annotation(demo[0], drawn, jobs=1) as annotation:
        submit = annotation.submit
        monkeypatch.setattr(annotation, "submit", lambda task: order.append(task.object) or submit(task))
        with Session(annotation, 1, lambda: None, lambda: None):
            until(lambda: len(order) >= 6)
    assert order[:6] == ["anna", "ben"] * 3


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (("anna", 99, Box(1, 2, 30, 40)), BoxError),
        (("anna", 0, Box(900, 2, 30, 40)), BoxError),
        (("a b", 0, Box(1, 2, 30, 40)), ObjectError),
        (("anna", 0, None), ObjectError),
    ],
)
def test_invalid_change_is_not_saved(session, saved, change, error):
    with pytest.raises(error):
        session.draw(*change)
    assert (saved, session.annotation.keyframes, session.can_undo) == ([], {}, False)


def test_change_that_cannot_be_saved_is_undone(demo, until):
    def full():
        raise ServiceError("the disk is full")

    with Annotation(demo[0], {}) as annotation, Session(annotation, 1, full, full) as session:
        until(lambda: session.decoded)
        with pytest.raises(ServiceError):
            session.draw("anna", 0, demo[1][0])
        assert annotation.keyframes == {}


def test_frames_before_a_damaged_one_are_annotated(walk, until, tmp_path):
    images = shutil.copytree(walk / "img", tmp_path / "img")
    (images / "0006.png").write_bytes(b"no image")
    with Annotation(images, {}) as annotation, Session(annotation, 1, lambda: None, lambda: None) as session:
        until(lambda: session.decoded)
        session.draw("anna", 4, Box(20, 20, 30, 30))
        until(lambda: session.problem and session.decoded)
        assert len(annotation.frames) == 5
        assert str(session.problem).startswith("5 frames could be read: ")
        assert "0006.png" in str(session.problem)
        until(lambda: len(session.tracks.get("anna", [])) == 5)


def test_passes_are_paused_while_an_image_is_decoded(session, monkeypatch):
    file = Path(session.annotation._folder.name, PAUSED)
    monkeypatch.setattr(VideoFrames, "__getitem__", lambda *_: file.exists())
    assert session.image(3) is True
    assert not file.exists()


def test_long_passes_leave_one_process_to_short_ones(demo, until, monkeypatch, tmp_path):
    monkeypatch.setattr(module, "_LONG", 10)
    submitted = []

    def submit(task):
        (count := tmp_path / str(len(submitted))).touch()
        submitted.append((task.object, task.frames))
        return Future(), count

    drawn = {name: {0: demo[1][0]._replace(x=10 + step)} for step, name in enumerate(("anna", "ben", "carl"))}
    drawn["carl"][3] = demo[1][3]
    with Annotation(demo[0], drawn) as annotation:
        monkeypatch.setattr(annotation, "submit", submit)
        with Session(annotation, 2, lambda: None, lambda: None) as session:
            until(lambda: len(submitted) >= 3)
            with session.lock:
                assert submitted == [("carl", 3), ("anna", FRAMES - 1), ("ben", FRAMES - 1)]


def test_session_that_ends_while_it_reads_is_not_decoded(demo):
    with Annotation(demo[0], {}) as annotation:
        session = Session(annotation, 1, lambda: None, lambda: None)
        session._closed = True
        with session:
            pass
        assert (session.decoded, session.problem) == (False, None)
        with pytest.raises(VideoError, match="not read yet"):
            session.finish()

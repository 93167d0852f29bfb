"""The board: what a page is told of the messages of a pipeline."""

from __future__ import annotations

import pytest

from catstream.messages import End, Health
from catstream.web.board import Board


@pytest.fixture
def board():
    return Board()


def test_a_page_is_told_once_of_what_is_new(board, facts):
    seen = {}
    board.take(facts.track(3), 1.0)
    assert board.news(seen)["track"] == {"frame": 3, "time": 0.3, "state": "present", "version": 1}
    assert board.news(seen) == {}
    board.take(facts.track(4), 1.01)
    assert set(board.news(seen)) == {"track"}


def test_who_comes_late_gets_all_there_is(board, facts):
    for frame in range(20):
        board.take(facts.track(frame), 0.5 * frame)
    early, late = {}, {}
    assert len(board.news(early)["points"]) == 20
    board.take(facts.track(20), 10.0)
    assert len(board.news(early)["points"]) == 1
    assert len(board.news(late)["points"]) == 21


def test_two_minutes_of_points_are_kept_however_fast_tracks_come(board, facts):
    for frame in range(20_000):
        board.take(facts.track(frame), 0.01 * frame)
    moments = [point[0] for point in board.news({})["points"]]
    assert len(moments) == 480
    assert moments[-1] - moments[0] == pytest.approx(120, abs=10)


def test_frames_a_second_are_those_of_the_last_two(board, facts):
    for frame in range(100):
        board.take(facts.track(frame), frame / 50)
    assert board.rate(2.0) == pytest.approx(50, abs=1)
    assert board.rate(3.0) == pytest.approx(25, abs=1)
    assert board.rate(9.0) == 0


def test_latency_is_from_a_frame_to_the_model_that_learned_from_it(board, facts):
    for frame in range(10):
        board.take(facts.track(frame), float(frame))
    board.take(facts.model(1, frame=6), 9.5)
    assert board.learned_after == pytest.approx(3.5)


def test_silence_and_the_end_are_told_apart(board, facts):
    told = {}
    board.take(Health("detector", 1.0, {"sent": 1.0}), 0.0)
    assert board.news(told)["status"]["standing"] == "running"
    board.lost("nothing came")
    assert board.news(told)["status"]["standing"] == "gone"
    board.take(facts.track(0), 10.0)
    board.take(End(2, "the source came to its end"), 11.0)
    board.lost("nothing came")
    status = board.news(told)["status"]
    assert (status["standing"], status["reason"]) == ("ended", "the source came to its end")


def test_a_process_that_is_silent_is_not_among_those_that_are_heard(board):
    names, told = ("compressor", "detector", "trainer"), {}
    for name in names:
        board.take(Health(name, 1.0, {"sent": 1.0}), 0.0)
    assert board.news(told)["status"]["processes"] == list(names)
    for moment in (1.0, 2.0, 3.0, 4.0, 5.0):
        for name in names[:2]:
            board.take(Health(name, 1.0, {}), moment)
    assert board.news(told)["status"]["processes"] == list(names[:2])
    board.take(Health("trainer", 1.0, {}), 6.0)
    assert board.news(told)["status"]["processes"] == list(names)
    board.lost("nothing came")
    assert board.news(told)["status"]["processes"] == []


def test_the_last_health_of_a_pipeline_is_not_taken_for_the_next_one(board):
    board.take(Health("detector", 1.0, {"sent": 7.0}), 9.0)
    board.take(End(2, "the source came to its end"), 10.0)
    board.take(Health("detector", 1.0, {"sent": 8.0}), 10.5)
    board.take(Health("compressor", 1.0, {}), 10.6)
    assert board.standing == "ended"
    board.take(Health("compressor", 2.0, {}), 20.0)
    assert board.standing == "running"


def test_the_trees_are_shown_as_the_last_health_said_after_the_end_too(board):
    board.take(End(2, "the source came to its end"), 10.0)
    board.take(Health("compressor", 1.0, {"object_leaves": 3.0, "rows": 200.0}), 10.1)
    board.lost("no pipeline is running")
    trees = board.news({})["trees"]
    assert (trees["trees"][0]["leaves"], trees["rows"]) == (3.0, 200.0)


def followed(board, facts, endpoint):
    """Show a page all of a pipeline; what the page was told."""
    told = {}
    board.attach(endpoint)
    board.take(Health("detector", 1.0, {"sent": 9.0}, source="first.mp4"), 0.0)
    board.take(Health("compressor", 1.0, {"object_leaves": 3.0, "rows": 90.0}), 0.0)
    for frame in (50, 51):
        board.take(facts.track(frame, version=5), frame / 10)
        board.take(facts.model(5, frame=50), frame / 10)
        board.take(facts.features(frame, wrong=1.0), frame / 10)
        board.take(facts.preview(frame), frame / 10)
    assert board.news(told)["film"]["shots"]
    return told


FIRST_SIGNS = {
    "its health at another endpoint": (
        "b",
        False,
        lambda _: Health("detector", 2.0, {"sent": 20.0}, source="second.mp4"),
    ),
    "its track at another endpoint": ("b", False, lambda facts: facts.track(70, version=9)),
    "its track at the same endpoint after the end": ("a", True, lambda facts: facts.track(70, version=9)),
    "its health at the same endpoint after the end": ("a", True, lambda _: Health("detector", 2.0, {"sent": 0.0})),
    "its trees at the same endpoint after the end": ("a", True, lambda _: Health("compressor", 2.0, {"rows": 0.0})),
    "its first track at the same endpoint": ("a", False, lambda facts: facts.track(0, version=0)),
}


@pytest.mark.parametrize(("endpoint", "ended", "sign"), FIRST_SIGNS.values(), ids=FIRST_SIGNS)
def test_nothing_of_a_pipeline_is_left_once_another_one_is_seen(board, facts, endpoint, ended, sign):
    told = followed(board, facts, "a")
    if ended:
        board.take(End(52, "the source came to its end"), 6.0)
    board.attach(endpoint)
    assert board.endpoint == "a"
    assert not set(board.news(told)) - {"status"}, "nothing goes before the other one is seen"
    board.take(sign(facts), 6.1)
    parts = board.news(told)
    assert next(iter(parts)) == "pipeline", "a page clears what it shows before it takes the rest"
    assert (parts["status"]["standing"], parts["status"]["endpoint"]) == ("running", endpoint)
    assert parts["status"]["source"] != "first.mp4"
    assert parts["film"]["shots"] == []
    assert parts["picture"] is None
    assert not any(tree["leaves"] for tree in parts["trees"]["trees"])
    assert len(parts.get("points", [])) <= 1
    assert board.picture(51) is None


def test_frames_of_another_pipeline_are_not_measured_by_the_model_of_the_one_before(board, facts):
    followed(board, facts, "a")
    board.attach("b")
    board.take(facts.track(0, version=0, state="bootstrapping"), 6.0)
    board.take(facts.features(0, wrong=1.0), 6.0)
    board.take(facts.preview(0), 6.0)
    assert board.film.frames == 0


def test_frames_of_another_object_are_not_measured_by_the_model_of_the_one_before(board, facts):
    followed(board, facts, "a")
    board.take(facts.track(60, version=0, state="bootstrapping"), 6.0)
    board.take(facts.model(6, frame=55), 6.0)
    board.take(facts.features(60, wrong=1.0), 6.0)
    board.take(facts.preview(60), 6.0)
    assert board.film.frames == 0
    board.take(facts.model(7, frame=61), 6.0)
    board.take(facts.features(61, wrong=1.0), 6.0)
    board.take(facts.preview(61), 6.0)
    assert board.film.frames == 1


def test_another_run_begins_another_film(board, facts):
    board.take(facts.track(0, version=5), 0.0)
    board.take(facts.model(5, frame=0), 0.0)
    board.take(facts.features(0, wrong=1.0), 0.0)
    board.take(facts.preview(0), 0.0)
    assert [shot["frame"] for shot in board.news({})["film"]["shots"]] == [0]
    board.take(facts.track(0, version=0, state="bootstrapping"), 5.0)
    assert board.news({})["film"]["shots"] == []


def test_pictures_that_were_told_of_lately_are_there_and_older_ones_are_not(board, facts):
    for frame in range(30):
        board.take(facts.preview(frame), 0.1 * frame)
    assert board.news({})["picture"] == {"frame": 29, "width": 64, "height": 48, "box": (4.0, 3.0, 20.0, 10.0)}
    assert board.picture(25).jpeg.endswith(b"25")
    assert board.picture(5) is None

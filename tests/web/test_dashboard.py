"""The dashboard: what a page is told of the messages of a pipeline."""

from __future__ import annotations

from time import monotonic

import pytest
from hypothesis import given
from hypothesis import strategies as some

from catstream.client.address import Address
from catstream.video.drawing import PALETTE
from catstream.web.dashboard import Dashboard
from catstream.web.feed import SILENCE_SECONDS, PipelineFeed
from catstream.wire.heads import TREES
from catstream.wire.messages import End, Health


@pytest.fixture
def dashboard():
    return Dashboard()


def test_page_gets_each_update_once_and_one_that_connects_late_gets_all_parts(dashboard, facts):
    early, late = {}, {}
    for frame in range(20):
        dashboard.take(facts.track(frame), 0.5 * frame)
    shown = {"name": "", "colour": PALETTE[0], "state": "present", "score": 0.75, "version": 1}
    parts = dashboard.updates(early)
    assert parts["tracks"] == {"frame": 19, "time": 1.9, "objects": [shown]}
    assert (len(parts["points"]), dashboard.updates(early)) == (20, {})
    dashboard.take(facts.track(20), 9.51)  # too early for a point
    assert set(dashboard.updates(early)) == {"tracks"}
    dashboard.take(facts.track(21), 10.0)
    assert [len(dashboard.updates(page)["points"]) for page in (early, late)] == [1, 21]


def test_frames_per_second_are_of_the_last_two_seconds_for_any_number_of_objects(dashboard, facts):
    for frame in range(100):
        for name in ("anna", "ben", "carl"):
            dashboard.take(facts.track(frame, name=name), frame / 50)
    assert dashboard.rate(2.0) == pytest.approx(50, abs=1)
    assert dashboard.rate(3.0) == pytest.approx(25, abs=1)
    assert dashboard.rate(9.0) == 0


def test_silence_and_the_end_are_different_phases(dashboard, facts):
    told = {}
    dashboard.take(Health("detector", 1.0, {"sent": 1.0}), 0.0)
    assert dashboard.updates(told)["status"]["phase"] == "running"
    dashboard.mark_silent("nothing came")
    assert dashboard.updates(told)["status"]["phase"] == "silent"
    dashboard.take(facts.track(0), 10.0)
    dashboard.take(End(1, "the source has ended"), 11.0)
    dashboard.mark_silent("nothing came")
    status = dashboard.updates(told)["status"]
    assert (status["phase"], status["reason"]) == ("ended", "the source has ended")


HOLDING = {
    "paused": ({"paused": 1.0}, "paused"),
    "waiting": ({"waiting": 1.0, "paused": 1.0}, "waiting for a box, paused"),
    "lost": ({"lost_seconds": 12.3}, "source lost for 12 s"),
}


@pytest.mark.parametrize(
    ("state", "counters", "words"), [(state, *told) for state, told in HOLDING.items()], ids=HOLDING
)
def test_while_no_frames_are_tracked_the_page_says_why_and_shows_no_positions(dashboard, facts, state, counters, words):
    told = {}
    dashboard.take(facts.tracking(3, "anna"), 0.0)
    dashboard.take(facts.track(2, name="anna"), 0.1)
    dashboard.updates(told)
    dashboard.take(Health("detector", 1.0, {"sent": 3.0, **counters}), 1.0)
    parts = dashboard.updates(told)
    assert (parts["status"]["state"], parts["status"]["words"]) == (state, words)
    assert [(one["state"], one["score"]) for one in parts["tracks"]["objects"]] == [(None, None)]
    assert parts["points"][-1][2] == {}
    dashboard.take(facts.track(3, name="anna"), 1.4)
    parts = dashboard.updates(told)
    assert parts["status"]["state"] == "running", "a track is newer than the report"
    assert [one["state"] for one in parts["tracks"]["objects"]] == ["present"]


def test_pipeline_that_tracks_is_ready_until_a_process_is_silent_for_some_seconds():
    feed, everyone = PipelineFeed(Address("run")), "no health report from: detector, compressor, trainer"
    assert feed.problem == everyone
    for ago, names, more, problem in (
        (SILENCE_SECONDS + 1.0, ("detector", "compressor", "trainer"), {}, everyone),
        (0.0, ("compressor", "trainer"), {}, "no health report from: detector"),
        (0.0, ("detector",), {}, ""),
        *((0.0, ("detector",), counters, words) for counters, words in HOLDING.values()),
    ):
        for name in names:
            feed.dashboard.take(Health(name, 1.0, {"sent": 1.0, **more}), monotonic() - ago)
        assert feed.problem == problem
    feed.dashboard.take(End(1, "cannot read /home/me/secret.mp4", failed=True), monotonic())
    assert feed.problem == "ended", "who has no token is told no name of a file"


def test_last_messages_of_a_run_do_not_belong_to_the_next_one(dashboard, facts):
    dashboard.take(Health("detector", 1.0, {"sent": 7.0}), 9.0, "one")
    dashboard.take(End(1, "the source has ended"), 10.0, "one")
    dashboard.take(Health("detector", 1.0, {"sent": 8.0}), 10.5, "one")
    dashboard.take(Health("compressor", 1.0, {}), 30.0, "one")
    assert dashboard.phase == "ended"
    dashboard.take(Health("compressor", 2.0, {}), 30.1, "two")
    assert dashboard.phase == "running"
    dashboard.take(facts.track(90, name="anna"), 30.2, "one")
    dashboard.take(End(1, "the source has ended"), 30.3, "one")
    assert (dashboard.phase, names(dashboard)) == ("running", [])


def test_trees_and_skipped_frames_of_the_last_reports_stay_after_the_end(dashboard):
    dashboard.take(Health("detector", 1.0, {"sent": 1.0, "skipped": 40.0}), 0.0)
    dashboard.take(End(1, "the source has ended"), 10.0)
    dashboard.take(learning({"object_leaves": 3.0, "rows": 200.0}), 10.1)
    dashboard.mark_silent("no pipeline is running")
    parts = dashboard.updates({})
    trees = parts["trees"]["objects"][""]
    assert (trees["leaves"], trees["rows"]) == ([3.0, *[0.0] * (len(TREES) - 1)], 200.0)
    assert parts["status"]["skipped"] == 40.0


def learning(counters):
    """The health report of a compressor that has trees of one object."""
    return Health("compressor", 1.0, counters, objects={"": counters})


def followed(dashboard, facts, endpoint, run="one"):
    """Show a page all of a pipeline; what the page was told."""
    told = {}
    dashboard.attach(endpoint)
    dashboard.take(Health("detector", 1.0, {"sent": 9.0}, source="first.mp4"), 0.0, run)
    dashboard.take(learning({"object_leaves": 3.0, "rows": 90.0}), 0.0, run)
    for frame in (50, 51):
        dashboard.take(facts.track(frame, version=5), frame / 10, run)
        dashboard.take(facts.model(5, frame=50), frame / 10, run)
        dashboard.take(facts.preview(frame), frame / 10, run)
    dashboard.updates(told)
    return told


@pytest.mark.parametrize("ended", [False, True])
def test_all_state_is_dropped_when_another_pipeline_appears(dashboard, facts, ended):
    told = followed(dashboard, facts, "a")
    if ended:
        dashboard.take(End(51, "the source has ended"), 6.0, "one")
    dashboard.attach("b")
    assert dashboard.endpoint == "a"
    assert not set(dashboard.updates(told)) - {"status"}, "nothing goes before the other one is seen"
    dashboard.take(facts.track(70, version=9), 6.1, "two")
    parts = dashboard.updates(told)
    assert next(iter(parts)) == "pipeline", "a page clears what it shows before it takes the rest"
    assert (parts["status"]["phase"], parts["status"]["endpoint"]) == ("running", "b")
    assert parts["status"]["source"] != "first.mp4"
    assert parts["picture"] is None
    assert not any(leaves for trees in parts["trees"]["objects"].values() for leaves in trees["leaves"])
    assert len(parts.get("points", [])) <= 1
    assert dashboard.picture(51 / 25) is None


def test_recent_pictures_are_kept_and_older_ones_are_not(dashboard, facts):
    for frame in range(130):
        dashboard.take(facts.preview(frame), 0.1 * frame)
    assert dashboard.updates({})["picture"] == {
        "frame": 129,
        "time": 129 / 25,
        "width": 64,
        "height": 48,
        "boxes": {"": (4.0, 3.0, 20.0, 10.0)},
    }
    assert dashboard.picture(100 / 25).jpeg.endswith(b"100")
    assert dashboard.picture(50 / 25) is None


def names(dashboard):
    return [one["name"] for one in dashboard.updates({})["tracks"]["objects"]]


def test_point_of_the_charts_has_each_object(dashboard, facts):
    dashboard.take(facts.tracking(5, "anna", "ben"), 0.0)
    dashboard.take(facts.track(5, name="anna", score=0.5), 1.0)
    dashboard.take(facts.track(5, name="ben", state="absent", score=0.1, version=3), 1.0)
    dashboard.take(facts.track(6, name="anna", score=0.25), 2.0)
    now, rate, objects = dashboard.updates({})["points"][-1]
    assert (now, rate, objects) == (2.0, 1.0, {"anna": (0.25, None, 1, True), "ben": (0.1, None, 3, False)})


def test_latency_is_the_time_from_a_track_to_the_model_of_its_frame_for_each_object(dashboard, facts):
    for frame in range(10):
        for name in ("anna", "ben", "carl"):
            dashboard.take(facts.track(frame, name=name), float(frame))
    dashboard.take(facts.model(1, 8, "anna"), 9.0)
    dashboard.take(facts.model(2, 4, "ben"), 9.5)
    dashboard.take(facts.model(1, 8, "anna"), 20.0)  # sent again to a late joiner
    dashboard.take(facts.track(10, name="carl", began=10), 20.1)
    dashboard.take(facts.model(3, 5, "carl"), 20.2)  # of another object that had the name before
    latencies = {name: each.model_latency for name, each in dashboard.objects.items()}
    assert latencies == {"anna": 1.0, "ben": 5.5, "carl": None}


def test_objects_of_a_paused_pipeline_are_known_from_its_health(dashboard, facts):
    dashboard.take(facts.tracking(7, "anna", "ben"), 0.0)
    shown = {"name": "anna", "colour": PALETTE[0], "state": "present", "score": 0.75, "version": 1}
    assert dashboard.updates({})["tracks"] == {
        "frame": None,
        "time": None,
        "objects": [shown, shown | {"name": "ben", "colour": PALETTE[1]}],
    }


@given(
    some.lists(
        some.tuples(some.sampled_from(["frame", "begin", "forget", "report", "arrival"]), some.sampled_from("abc"))
    )
)
def test_tracked_objects_are_shown_and_no_others_once_the_reports_have_arrived(facts, events):
    dashboard, alive, seq, reports = Dashboard(), [], 0, []
    for event, name in events:
        if event == "begin" and name not in alive:
            alive.append(name)
        if event in ("frame", "begin"):
            seq += 1
            for each in alive:
                dashboard.take(facts.track(seq - 1, name=each), float(seq))
        elif event == "forget" and name in alive:
            alive.remove(name)
        elif event == "report":
            reports.append(facts.tracking(float(seq), *alive))
        elif event == "arrival" and reports:  # later than tracks that were sent after it
            dashboard.take(reports.pop(0), float(seq))
            assert set(alive) <= set(dashboard.objects)
    for report in (*reports, facts.tracking(float(seq), *alive)):
        dashboard.take(report, float(seq))
    assert set(dashboard.objects) == set(alive)

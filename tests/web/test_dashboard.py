"""The dashboard: the updates that a page receives about the messages of a pipeline."""

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

END = End(1, "the source has ended")


@pytest.fixture
def dashboard():
    return Dashboard()


def test_page_receives_each_update_once_and_a_late_one_all_parts(dashboard, facts):
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


def test_rate_counts_each_frame_of_the_last_two_seconds_once(dashboard, facts):
    for frame in range(100):
        for name in ("anna", "ben", "carl"):
            dashboard.take(facts.track(frame, name=name), frame / 50)
    assert dashboard.rate(2.0) == pytest.approx(50, abs=1)
    assert dashboard.rate(3.0) == pytest.approx(25, abs=1)
    assert dashboard.rate(9.0) == 0


def test_silence_and_the_end_are_different_phases(dashboard, facts):
    dashboard.take(Health("detector", 1.0, {"sent": 1.0}), 0.0)
    assert dashboard.phase == "running"
    dashboard.mark_silent("nothing came")
    assert dashboard.phase == "silent"
    dashboard.take(facts.track(0), 10.0)
    dashboard.take(END, 11.0)
    dashboard.mark_silent("nothing came")
    status = dashboard.updates({})["status"]
    assert (status["phase"], status["reason"]) == ("ended", END.reason)


HOLDING = {
    "paused": ({"paused": 1.0}, "paused"),
    "waiting": ({"waiting": 1.0, "paused": 1.0}, "waiting for a box, paused"),
    "lost": ({"lost_seconds": 12.3}, "source lost for 12 s"),
}


@pytest.mark.parametrize("state", HOLDING)
def test_page_of_a_run_on_hold_has_the_reason_and_no_positions(dashboard, facts, state):
    counters, words = HOLDING[state]
    dashboard.take(facts.tracking(3, "anna"), 0.0)
    dashboard.take(facts.track(2, name="anna"), 0.1)
    dashboard.take(Health("detector", 1.0, {"sent": 3.0, **counters}), 1.0)
    parts = dashboard.updates({})
    assert (parts["status"]["state"], parts["status"]["words"]) == (state, words)
    assert [(one["state"], one["score"]) for one in parts["tracks"]["objects"]] == [(None, None)]
    assert parts["points"][-1][2] == {}
    dashboard.take(facts.track(3, name="anna"), 1.4)
    parts = dashboard.updates({})
    assert parts["status"]["state"] == "running", "a track is newer than the report"
    assert [one["state"] for one in parts["tracks"]["objects"]] == ["present"]


def test_pipeline_is_ready_while_it_tracks_and_all_processes_report():
    feed = PipelineFeed(Address("run"))
    for seconds_ago, names, counters, problem in (
        (SILENCE_SECONDS + 1.0, ["detector", "compressor", "trainer"], {}, "detector, compressor, trainer"),
        (0.0, ["compressor", "trainer"], {}, "no health report from: detector"),
        (0.0, ["detector"], {}, ""),
        *((0.0, ["detector"], counters, words) for counters, words in HOLDING.values()),
    ):
        for name in names:
            feed.dashboard.take(Health(name, 1.0, {"sent": 1.0, **counters}), monotonic() - seconds_ago)
        assert feed.problem.endswith(problem)
        assert problem or not feed.problem
    feed.dashboard.take(End(1, "cannot read /home/me/secret.mp4", failed=True), monotonic())
    assert feed.problem == "ended", "without a token, no file name is shown"


def test_last_messages_of_a_run_do_not_belong_to_the_next_one(dashboard, facts):
    dashboard.take(Health("detector", 1.0, {"sent": 7.0}), 9.0, "one")
    dashboard.take(END, 10.0, "one")
    dashboard.take(Health("detector", 1.0, {"sent": 8.0}), 10.5, "one")
    dashboard.take(Health("compressor", 1.0, {}), 30.0, "one")
    assert dashboard.phase == "ended"
    dashboard.take(Health("compressor", 2.0, {}), 30.1, "two")
    assert dashboard.phase == "running"
    dashboard.take(facts.track(90, name="anna"), 30.2, "one")
    dashboard.take(END, 30.3, "one")
    assert (dashboard.phase, [*dashboard.objects]) == ("running", [])


def test_trees_and_skipped_frames_are_shown_after_the_end(dashboard):
    dashboard.take(Health("detector", 1.0, {"sent": 1.0, "skipped": 40.0}), 0.0)
    dashboard.take(END, 10.0)
    dashboard.take(Health("compressor", 1.0, {}, objects={"": {"object_leaves": 3.0, "rows": 200.0}}), 10.1)
    dashboard.mark_silent("no pipeline is running")
    parts = dashboard.updates({})
    trees = parts["trees"]["objects"][""]
    assert (trees["leaves"], trees["rows"]) == ([3.0, *[0.0] * (len(TREES) - 1)], 200.0)
    assert parts["status"]["skipped"] == 40.0


@pytest.mark.parametrize("ended", [False, True])
def test_all_state_is_dropped_when_another_pipeline_appears(dashboard, facts, ended):
    sent = {}
    dashboard.attach("a")
    dashboard.take(Health("detector", 1.0, {"sent": 9.0}, source="first.mp4"), 0.0, "one")
    dashboard.take(Health("compressor", 1.0, {}, objects={"": {"object_leaves": 3.0}}), 0.0, "one")
    for message in (facts.track(50), facts.track(51), facts.preview(51)):
        dashboard.take(message, 5.0, "one")
    dashboard.updates(sent)
    if ended:
        dashboard.take(END, 6.0, "one")
    dashboard.attach("b")
    assert dashboard.endpoint == "a"
    assert not set(dashboard.updates(sent)) - {"status"}, "nothing is dropped before the first message of the other"
    dashboard.take(facts.track(70, version=9), 6.1, "two")
    parts = dashboard.updates(sent)
    assert next(iter(parts)) == "pipeline", "the page drops its state first"
    assert (parts["status"]["phase"], parts["status"]["endpoint"]) == ("running", "b")
    assert parts["status"]["source"] != "first.mp4"
    assert parts["picture"] is None
    assert not any(leaves for trees in parts["trees"]["objects"].values() for leaves in trees["leaves"])
    assert len(parts.get("points", [])) <= 1
    assert dashboard.picture(51 / 25) is None


def test_recent_pictures_are_available_and_older_ones_are_not(dashboard, facts):
    for frame in range(130):
        dashboard.take(facts.preview(frame), 0.1 * frame)
    boxes = {"": (4.0, 3.0, 20.0, 10.0)}
    newest = {"frame": 129, "time": 129 / 25, "width": 64, "height": 48, "boxes": boxes}
    assert dashboard.updates({})["picture"] == newest
    assert dashboard.picture(100 / 25).jpeg.endswith(b"100")
    assert dashboard.picture(50 / 25) is None


def test_point_of_the_charts_has_each_object(dashboard, facts):
    dashboard.take(facts.tracking(5, "anna", "ben"), 0.0)
    dashboard.take(facts.track(5, name="anna", score=0.5), 1.0)
    dashboard.take(facts.track(5, name="ben", state="absent", score=0.1, version=3), 1.0)
    dashboard.take(facts.track(6, name="anna", score=0.25), 2.0)
    now, rate, objects = dashboard.updates({})["points"][-1]
    assert (now, rate, objects) == (2.0, 1.0, {"anna": (0.25, None, 1, True), "ben": (0.1, None, 3, False)})


def test_latency_is_the_time_from_a_track_to_its_model_by_object(dashboard, facts):
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
    tracks = dashboard.updates({})["tracks"]
    assert tracks["frame"] is None
    assert [(one["name"], one["colour"], one["state"]) for one in tracks["objects"]] == [
        ("anna", PALETTE[0], "present"), ("ben", PALETTE[1], "present"),
    ]  # fmt: skip


@given(
    some.lists(
        some.tuples(some.sampled_from(["frame", "begin", "forget", "report", "arrival"]), some.sampled_from("abc"))
    )
)
def test_exactly_the_tracked_objects_are_shown(facts, events):
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

"""Events of histories of tracks, of health reports, and in zones."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.box import Box
from catstream.errors import SettingsError
from catstream.output.events import WHEN, Events, check_zones
from catstream.wire.messages import Health, Track

#: A square of x and y from 40 to 60.
DOOR = {"door": ((40, 40), (60, 40), (60, 60), (40, 60))}


def tracks(history, name="", began=0, first=0):
    """A track a second: a digit is the box whose centre is at x = ten times the digit and y = 50, "." none."""
    for frame, x in enumerate(history, first):
        box = None if x == "." else Box(10 * int(x) - 5, 45, 10, 10)
        yield Track(frame, frame, "present" if box else "absent", box, 0.9, 1, object=name, began=began)


LOST = ["0 found", "0 entered door", "3 left door", "3 lost"]


def texts(events):
    return [f"{event.track.time:g} {event.kind} {event.zone}".strip() for event in events]


@pytest.mark.parametrize(
    ("history", "expected"),
    [
        ("...", ["2 ended"]),
        ("..1", ["2 found", "2 ended"]),
        ("1..1", ["0 found", "3 ended"]),  # shorter than three seconds
        ("1...1", ["0 found", "3 lost", "4 returned", "4 ended"]),
        ("1....", ["0 found", "3 lost", "4 ended"]),
        ("1....1...", ["0 found", "3 lost", "5 returned", "8 lost", "8 ended"]),
        ("1345", ["0 found", "2 entered door", "3 left door", "3 ended"]),  # it ended there
        ("4371", ["0 found", "0 entered door", "3 left door", "3 ended"]),  # 3 and 7 are within the margin
        ("3737", ["0 found", "3 ended"]),  # it never was in the zone
        ("5...5", [*LOST, "4 returned", "4 entered door", "4 left door", "4 ended"]),
        ("5...1", [*LOST, "4 returned", "4 ended"]),
    ],
)
def test_history_of_an_object_gives_its_events(history, expected):
    events = Events(DOOR, WHEN | {"lost": 3.0})
    assert texts([*events.update([*tracks(history)]), *events.close()]) == expected


def test_only_the_selected_events_are_returned():
    events = Events(DOOR, {"lost": 1.0, "entered": 0.0})
    assert texts([*events.update([*tracks("5.1")]), *events.close()]) == ["0 entered door", "1 lost"]


@given(st.text(".0123456789", max_size=60))
def test_events_of_any_history_are_in_pairs_and_agree_with_the_status(history):
    events, kinds, inside = Events(DOOR), [], set()
    for track in tracks(history):
        for event in events.update([track]):
            kinds.append(event.kind)
            {"entered": inside.add, "left": inside.discard}.get(event.kind, lambda _: None)(event.zone)
        status = events.status("")
        assert set(status["zones"]) == inside
        assert status["present"] or not inside
    kinds += [event.kind for event in events.close()]
    assert kinds.count("entered") == kinds.count("left")
    assert kinds.count("lost") - kinds.count("returned") in (0, 1)
    assert kinds[kinds.index("ended") :] == ["ended"] if history else not kinds


def test_objects_of_a_lost_source_are_unknown_until_their_next_track():
    events = Events(DOOR, WHEN | {"lost": 3.0})
    events.update([*tracks("5")])
    seconds = (0.0, 1.0, 3.0, 9.0, 0.0, 2.0, 0.0)
    reports = [events.update_run(Health("detector", 0.0, {"lost_seconds": each})) for each in seconds]
    assert [[(event.kind, event.facts["seconds"]) for event in each] for each in reports] == [
        [], [], [("source_lost", 3.0)], [], [("source_back", 9.0)], [], [],
    ]  # fmt: skip
    assert events.status("") == {"present": None, "zones": []}
    assert texts(events.update([*tracks("5", first=1)])) == []
    assert events.status("") == {"present": True, "zones": ["door"]}


def test_failed_writes_and_their_recovery_are_events():
    events = Events({})
    detector = [{"write_failed": failed, "not_written": 7.0} for failed in (0, 1, 1, 0)]
    compressor = [{"write_failed": 1}, {}, *({"write_failed": failed} for failed in (1, 0, 0))]  # {}: restarted
    reports = [Health("detector", 0, counters, "full", "cam") for counters in detector]
    reports += [Health("compressor", 0, each, "read-only" * each.get("write_failed", 0)) for each in compressor]
    found = [event for report in reports for event in events.update_run(report)]
    assert [(event.kind, *event.facts.values()) for event in found] == [
        ("write_failed", "cam", 7, "full"),
        ("write_resumed", "cam", 7, "full"),
        ("write_failed", "cam", 0, "read-only"),
        ("write_resumed", "cam", 0, "read-only"),
    ]


def test_new_object_of_the_same_name_ends_the_earlier_one():
    events = Events(DOOR)
    assert texts(events.update([*tracks("5"), *tracks("1", began=1, first=1)])) == [
        "0 found", "0 entered door", "0 left door", "0 ended", "1 found",
    ]  # fmt: skip


@pytest.mark.parametrize("together", [True, False])
def test_forgotten_object_ends_once_the_others_have_four_frames_more(together):
    events, anna, ben = Events({}), [*tracks("11111111", "anna")], [*tracks("1111", "ben")]
    frames = [[one, other] for one, other in zip(anna, ben, strict=False)] + [[one] for one in anna[4:]]
    if not together:
        frames = [[track] for frame in frames for track in frame]
    events_by_frame = [texts(events.update(frame)) for frame in frames]
    assert events_by_frame[-1] == ["3 ended"]
    assert texts(events.close()) == ["7 ended"]


def test_lost_messages_of_an_object_do_not_end_it():
    """From the rest of one frame up to the beginning of a later one."""
    names = ("anna", "ben", "carl")
    frames = [*zip(*(tracks("1111111", name) for name in names), strict=True)]
    came = [*frames[0], frames[1][0], frames[4][2], *frames[5], *frames[6]]
    events = Events({})
    assert [event.kind for track in came for event in events.update([track])] == ["found"] * 3


FRAME = (320, 240)


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        ("0.1,0.1 0.9,0.1 0.9,0.9 0.1,0.9", "not fractions"),
        ("1,2 3,4", "at least 3 corners, got 2"),
        ("10,10 200,10 200,10.001", "on a line"),
        ("0,0 100,100 100,0 0,100", "edges cross"),
        ("50,0 80,100 0,40 100,40 20,100", "edges cross"),
        ("2000,900 2100,900 2100,1000", "outside the frame of 320x240"),
        ("310,-500 900,-500 900,90", "outside the frame"),  # the box around it is not outside
        ("1e12,1e12 2e12,1e12 2e12,2e12", "outside the frame"),
        ("1,2 3,4 5,nan", "finite"),
    ],
)
def test_zone_that_nothing_can_enter_is_an_error(corners, words):
    points = tuple(tuple(map(float, corner.split(","))) for corner in corners.split())
    with pytest.raises(SettingsError, match=f"zone door: .*{words}"):
        check_zones({"door": points}, FRAME)


@pytest.mark.parametrize("name", ["it's", "", "a b", "a/b", "a#", "{{x}}"])
def test_zone_with_an_unsafe_name_is_an_error(name):
    with pytest.raises(SettingsError, match=r"^zone: .* is not a name: expected text of 1 to 64 letters, digits"):
        check_zones({name: ((0, 0), (90, 0), (90, 90))})


@pytest.mark.parametrize(
    "corners",
    [
        "0,0 320,0 320,240 0,240",
        "-50,-50 400,-50 400,300 -50,300",
        "300,200 900,200 900,900",
        "10,10 10,10 60,10 60,60",  # a corner twice
        "10,10 100,10 100,100 55,100 55,50 50,50 50,100 10,100",  # not convex
        "5,5 7,5 7,7",
    ],
)
def test_zone_partly_in_the_frame_is_valid(corners):
    check_zones({"door": tuple(tuple(map(float, corner.split(","))) for corner in corners.split())}, FRAME)

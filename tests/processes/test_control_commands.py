"""The changes of each command to the desired state, and its answer."""

from dataclasses import replace

import numpy as np
import pytest

from catstream.base.box import Box, Window
from catstream.base.settings import Settings
from catstream.detection.objects import Detectors
from catstream.errors import CatstreamError, ObjectError, SettingsError
from catstream.processes.control_commands import check_room, continues, execute, object_of
from catstream.processes.decisions import DesiredObject, DesiredState
from catstream.wire.messages import LARGEST_INITIAL_MODEL, Command, DetectorState, Model

BOX, PLACE = Box(40, 30, 20, 20), Window(40, 30, 20, 20)
SAVED = DesiredObject(BOX, 1, "digest", 1000, 5)


@pytest.fixture
def tracked():
    """Detectors after frame 6, of which anna has model 4, ben none, and carl is searched for."""
    detectors = Detectors(Settings(run={"max_objects": 4}))
    for name, version, first in (("anna", 4, PLACE), ("ben", 0, PLACE), ("carl", 5, None)):
        detector = detectors.add(name)
        detector.state = DetectorState(0, "weak", PLACE, PLACE, first)
        detector.model = Model(version, 0, np.empty(0, np.float32), 0.0)
    detectors.seq = 7
    return detectors


def desired(*names):
    return DesiredState({name: DesiredObject(BOX, 1) for name in names})


def command(verb, name="", **more):
    needed = {"set-box": {"box": BOX}, "search": {"model": b"a file"}}.get(verb, {})
    return Command("1", verb, object=name, **needed, **more)


def test_pause_resume_and_stop_change_one_thing_each(tracked):
    before = desired("anna")
    paused, answer = execute(command("pause"), before, tracked)
    assert (paused, answer.reason) == (replace(before, paused=True), "paused after frame 6")
    assert execute(command("resume"), paused, tracked)[0] == before
    stopped, answer = execute(command("stop"), before, tracked)
    assert (stopped, answer.reason) == (replace(before, stopped=True), "the stream ends after frame 6")
    assert execute(command("resume"), desired(), tracked)[1].reason == "waiting for a box"
    tracked.seq = 0
    assert execute(command("pause"), before, tracked)[1].reason == "paused before the first frame"


@pytest.mark.parametrize(
    ("paused", "seconds", "reason"),
    [
        (False, 30.0, "paused for 30 s after frame 6"),
        (False, 0.0, "resumed after frame 6"),
        (True, 30.0, "paused after frame 6"),
        (True, 0.0, "paused after frame 6"),
    ],
)
def test_pause_with_a_limit_does_not_change_the_desired_state(tracked, paused, seconds, reason):
    before = replace(desired("anna"), paused=paused)
    after, answer = execute(command("pause", seconds=seconds), before, tracked)
    assert (after, answer.reason) == (before, reason)


def test_search_replaces_its_object_from_the_next_frame_on(tracked):
    after, answer = execute(command("search", "anna"), desired("anna", "ben"), tracked, SAVED)
    assert after.objects == {"ben": DesiredObject(BOX, 1), "anna": replace(SAVED, begins=8)}
    assert answer.reason == "anna is searched for from frame 7 on, by model 5"


@pytest.mark.parametrize(
    ("names", "name", "model", "error"),
    [
        (("a", "b", "c", "d"), "e", SAVED, ObjectError),
        (("a", "b"), "", SAVED, ObjectError),
        (("a",), "", None, ObjectError),
        (("a",), "b", replace(SAVED, size=LARGEST_INITIAL_MODEL + 1), SettingsError),
    ],
    ids=["too many", "which one", "no model", "too large"],
)
def test_impossible_search_is_an_error(tracked, names, name, model, error):
    with pytest.raises(error):
        execute(command("search", name), desired(*names), tracked, model)


def test_run_waits_for_a_box_after_its_last_object_is_forgotten(tracked):
    after, answer = execute(command("forget", "ben"), desired("anna", "ben"), tracked)
    assert after == desired("anna")
    assert (answer.object, answer.reason) == ("ben", "ben is no longer tracked after frame 6")
    after, answer = execute(command("forget"), after, tracked)
    assert not after.objects
    assert answer.reason.endswith("no object is left, so the run waits for a box")


@pytest.mark.parametrize("verb", ["forget", "save"])
@pytest.mark.parametrize(("names", "name"), [((), ""), (("anna",), "ben"), (("anna", "ben"), "")])
def test_command_for_an_unknown_object_is_an_error(tracked, verb, names, name):
    with pytest.raises(CatstreamError, match=r"no object|ambiguous object"):
        execute(command(verb, name), desired(*names), tracked)


@pytest.mark.parametrize(
    ("name", "done", "reason"),
    [("anna", True, "model 4 after"), ("ben", False, "has no model yet"), ("carl", False, "not detected yet")],
)
def test_object_without_a_model_or_detection_is_not_saved(tracked, name, done, reason):
    before = desired("anna", "ben", "carl")
    after, answer = execute(command("save", name), before, tracked)
    assert (after, answer.done, answer.frame) == (before, done, 6)
    assert answer.reason.startswith(reason) or reason in answer.reason


def test_box_without_a_name_is_for_the_only_object():
    assert object_of(command("set-box"), desired("anna")) == "anna"
    assert object_of(command("set-box"), desired("", "anna")) == object_of(command("set-box"), desired()) == ""


def test_object_beyond_the_limit_is_an_error():
    four = desired("anna", "b", "c", "d")
    check_room("anna", four, 4)
    with pytest.raises(ObjectError):
        check_room("e", four, 4)


@pytest.mark.parametrize(
    ("name", "keep", "begins", "result"),
    [
        ("anna", True, 1, True),
        pytest.param("ben", True, 1, False, id="it has no model"),
        pytest.param("anna", False, 1, False, id="not requested"),
        pytest.param("anna", True, 8, False, id="it begins with the next frame"),
    ],
)
def test_box_continues_an_object_with_a_model(tracked, name, keep, begins, result):
    state = DesiredState({each: DesiredObject(BOX, begins) for each in ("anna", "ben")})
    assert continues(command("set-box", keep=keep), name, state, tracked) == result

"""Laws of commands: each is answered once, and the last command for an object or a run holds, in every order."""

from __future__ import annotations

import itertools
from functools import cache

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from catstream.box import Box
from catstream.detection.objects import Detectors
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import Command
from catstream.multi import MultiTracker
from catstream.services.commands import STOPPED, CommandHandler
from catstream.services.desired import DesiredObject, DesiredState, PastObject
from catstream.services.model_files import ModelFiles
from catstream.settings import Settings
from catstream.video.demo import render

((IMAGE, _),) = render(1, (160, 120))
FRAME = Pyramid.of(IMAGE)
BOXES = [Box(40, 30, 20, 20), Box(400, 30, 20, 20)]  # the second is outside of the frame
NAMES = ["", "anna", "ben", "carl"]
MOST = 2
QUICK = Settings(teaching={"copies": 0}, coreset={"size": 8}, run={"objects_most": MOST})


@cache
def saved(size=8):
    """A saved model of the object at the first of the boxes."""
    tracker = MultiTracker(QUICK.but({"coreset.size": size}))
    tracker.init(IMAGE, {"": BOXES[0]})
    for _ in range(9):
        tracker.update(IMAGE)
    return tracker.learned()


class Steering(RuleBasedStateMachine):
    """A handler, the commands that it was given, and the state that they should have led to."""

    def __init__(self):
        super().__init__()
        self.detectors = Detectors(QUICK)
        self.handler = CommandHandler(self.detectors, DesiredState(), ModelFiles(None))
        self.ids = map(str, itertools.count())
        self.open, self.paused, self.stopped = set(), False, False
        self.objects = {}  # as they should be

    def give(self, verb, name="", box=None, keep=False, model=None):
        command = Command(next(self.ids), verb, box, keep, name, model)
        self.open.add(command.id)
        return self.answered(self.handler.carry_out([command]))

    def answered(self, answers):
        for answer in answers:
            self.open.remove(answer.id)  # KeyError: answered twice
        return answers

    def meant(self, name):
        """The object that a name stands for, None if that is not clear."""
        if name or not self.objects or "" in self.objects:
            return name
        return None if len(self.objects) > 1 else next(iter(self.objects))

    @rule(verb=st.sampled_from(["pause", "resume"]))
    def pause_or_resume(self, verb):
        (answer,) = self.give(verb)
        assert answer.done != self.stopped
        self.paused = self.paused if self.stopped else verb == "pause"

    @rule(name=st.sampled_from(NAMES), box=st.sampled_from(BOXES), keep=st.booleans())
    def set_box(self, name, box, keep):
        answers = self.give("set-box", name, box, keep)
        assert bool(answers) == self.stopped
        assert not any(answer.done for answer in answers)

    @rule(name=st.sampled_from(NAMES), damaged=st.booleans())
    def search(self, name, damaged):
        meant, data = self.meant(name), saved().to_bytes()
        (answer,) = self.give("search", name, model=data[:-9] if damaged else data)
        room = meant is not None and len(self.objects.keys() | {meant}) <= MOST
        assert answer.done == (room and not damaged and not self.stopped)
        if answer.done:
            self.objects.pop(meant, None)
            model = self.handler.models.add(saved())
            self.objects[meant] = DesiredObject(saved().box, self.detectors.seq + 1, model)

    @rule(name=st.sampled_from(NAMES))
    def forget(self, name):
        meant = self.meant(name)
        (answer,) = self.give("forget", name)
        assert answer.done == (meant in self.objects and not self.stopped)
        if answer.done:
            assert answer.object == meant
            del self.objects[meant]

    @precondition(lambda self: self.detectors.seq < 4)
    @rule()
    def next_frame(self):
        given, answers = self.handler.begin(FRAME, 0.0)
        done = [answer for answer in self.answered(answers) if answer.done]
        assert [answer.object for answer in done] == list(given)
        seq, kept = self.detectors.seq + 1, {a.object for a in done if a.reason.startswith("the same object")}
        assert all(self.objects[name].model and self.objects[name].begins < seq for name in kept)
        for name in [name for name in given if name not in kept]:
            self.objects.pop(name, None)
            self.objects[name] = DesiredObject(BOXES[0], seq)
        if self.objects:
            for name, each in self.objects.items():
                if each.model and each.begins == seq:
                    self.detectors.seek(name, saved().model, saved().box, saved().likeness())
            tracks, features = self.detectors.step(FRAME, 0.0, given)
            assert tracks.tracks.keys() == features.objects.keys() == self.objects.keys()

    @rule(name=st.sampled_from(NAMES))
    def save(self, name):
        (answer,) = self.give("save", name)
        assert not answer.done or self.objects[answer.object].model, "nothing is trained here"
        assert answer.reason

    @rule()
    def lose_the_source(self):
        assert not any(answer.done for answer in self.answered(self.handler.reject_boxes("it is lost")))
        assert not self.open

    @precondition(lambda self: self.detectors.seq)
    @rule()
    def stop(self):
        self.give("stop")
        self.stopped = True
        assert not self.open

    @invariant()
    def the_last_command_of_each_kind_holds(self):
        desired = self.handler.desired
        assert (desired.paused, desired.stopped) == (self.paused, self.stopped)
        assert list(desired.objects.items()) == list(self.objects.items())
        assert self.handler.needed_models >= {each.model for each in self.objects.values() if each.model}
        assert len(self.objects) <= MOST
        assert self.handler.end_reason == (STOPPED if self.stopped else "")
        assert len(self.open) == 0 or self.handler.has_box

    @invariant()
    def each_message_had_the_tracks_of_the_objects_of_its_time(self):
        for was in self.handler.desired.past:
            assert 1 <= was.each.begins <= was.last <= self.detectors.seq


TestSteering = Steering.TestCase
TestSteering.settings = settings(max_examples=40, stateful_step_count=14)


@pytest.fixture
def handler():
    """The handler of a run with the objects anna and ben in its first frame."""
    handler = CommandHandler(Detectors(QUICK), DesiredState(), ModelFiles(None))
    answer(handler, Command("a", "set-box", BOXES[0], object="anna"), Command("b", "set-box", BOXES[0], object="ben"))
    return handler


def answer(handler, *commands):
    """The answers to commands, whose boxes are for one frame, as done and reason."""
    answers = handler.carry_out(commands)
    if handler.has_box:
        given, later = handler.begin(FRAME, 0.0)
        answers += later
        handler._detectors.step(FRAME, 0.0, given)
    return [(each.done, each.reason) for each in answers]


def test_two_boxes_for_two_objects_begin_them_in_one_frame(handler):
    objects = handler.desired.objects
    assert objects == {name: DesiredObject(BOXES[0], begins=1) for name in ("anna", "ben")}


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (Command("1", "set-box", BOXES[0]), "which object? This run has anna, ben: give a name"),
        (Command("1", "forget"), "which object? This run has anna, ben: give a name"),
        (Command("1", "save"), "which object? This run has anna, ben: give a name"),
        (Command("1", "forget", object="carl"), "there is no object 'carl': the objects are anna, ben"),
        (Command("1", "save", object="ben"), "nothing was learned of the object yet"),
        (Command("1", "set-box", BOXES[0], object="carl"), "3 objects are more than 2: follow fewer"),
        (Command("1", "set-box", BOXES[0], object="an na"), "'an na' is not a name: expected 1 to 64 letters"),
        (Command("1", "set-box", BOXES[1], object="anna"), "outside the frame"),
        (Command("1", "search", object="anna", model=b"torn"), "the file is not an undamaged file of catstream"),
        (
            Command("1", "search", object="anna", model=saved(16).to_bytes()),
            "learned with coreset.size=16, this run has",
        ),
        (Command("1", "search", object="carl", model=saved().to_bytes()), "3 objects are more than 2: follow fewer"),
    ],
    ids=lambda value: f"{value.verb} {value.object}" if isinstance(value, Command) else "",
)
def test_a_command_that_cannot_be_carried_out_is_rejected_with_the_reason_and_changes_nothing(handler, command, why):
    before = handler.desired
    ((done, reason),) = answer(handler, command)
    assert not done
    assert why in reason
    assert handler.desired == before


def test_a_box_for_the_name_of_an_object_begins_another_object_of_that_name(handler):
    ((done, reason),) = answer(handler, Command("1", "set-box", BOXES[0], object="anna"))
    assert (done, reason) == (True, f"another object anna begins at {BOXES[0]} in frame 1")
    assert handler.desired.objects["anna"].begins == 2
    assert handler.desired.past == (PastObject("anna", DesiredObject(BOXES[0], 1), 1),)


def test_once_the_last_object_was_forgotten_a_paused_run_waits_for_a_box(handler):
    answer(handler, Command("1", "pause"))
    assert answer(handler, Command("2", "forget", object="ben")) == [(True, "ben is no longer tracked after frame 0")]
    waits = "anna is no longer tracked after frame 0: no object is left, so the run waits for a box"
    assert answer(handler, Command("3", "forget")) == [(True, waits)]
    assert answer(handler, Command("4", "resume")) == [(True, "waiting for a box")]
    ((_, reason),) = answer(handler, Command("5", "forget"))
    assert "no object is tracked yet" in reason
    answer(handler, Command("6", "set-box", BOXES[0], object="anna"))
    assert not handler.desired.holds


def test_a_frame_that_is_repeated_has_a_track_of_each_object_of_its_time(handler):
    answer(handler, Command("1", "forget", object="ben"))
    answer(handler, Command("2", "set-box", BOXES[0], object="anna"))
    first, other = DesiredObject(BOXES[0], 1), DesiredObject(BOXES[0], 2)
    assert handler.desired.objects_at(1) == {"anna": first, "ben": first}
    assert handler.desired.objects_at(2) == {"anna": other}


def test_a_handler_that_is_released_forgets_that_it_was_stopped():
    desired = DesiredState({"": DesiredObject(BOXES[0], begins=1)})
    handler = CommandHandler(Detectors(QUICK), desired, ModelFiles(None))
    handler.carry_out([Command("1", "stop")])
    assert handler.desired.stopped
    handler.clear_stop()
    assert handler.desired == desired
    assert handler.end_reason == STOPPED


def test_commands_for_objects_wait_until_all_frames_of_an_earlier_detector_are_repeated():
    detectors = Detectors(QUICK)
    handler = CommandHandler(detectors, DesiredState({"anna": DesiredObject(BOXES[0], 1)}), ModelFiles(None))
    given = [Command("1", "forget", object="anna"), Command("2", "pause")]
    assert [(answer.id, answer.done) for answer in handler.carry_out(given, repeats=True)] == [("2", True)]
    assert list(handler.desired.objects) == ["anna"]
    detectors.seq = 7
    (answer,) = handler.carry_out([])
    assert (answer.id, answer.done) == ("1", True)
    assert handler.desired.past == (PastObject("anna", DesiredObject(BOXES[0], 1), 7),)


def test_commands_that_wait_when_the_stream_ends_are_rejected():
    handler = CommandHandler(Detectors(QUICK), DesiredState(), ModelFiles(None))
    assert handler.carry_out([Command("1", "forget", object="anna")], repeats=True) == []
    (answer,) = handler.end("it was stopped")
    assert (answer.id, answer.done, answer.reason) == ("1", False, "the pipeline is ending: it was stopped")


def test_a_saved_model_that_is_too_large_for_the_message_of_a_frame_is_refused_and_the_run_goes_on(monkeypatch):
    data = saved().to_bytes()
    monkeypatch.setattr("catstream.run.learned.LARGEST_GIVEN_MODELS", 2 * len(data))
    handler = CommandHandler(Detectors(QUICK.but({"run.objects_most": 3})), DesiredState(), ModelFiles(None))
    answers = [
        answer
        for number, name in enumerate(["anna", "ben", "carla"])
        for answer in handler.carry_out([Command(str(number), "search", None, object=name, model=data)])
    ]
    assert [answer.done for answer in answers] == [True, True, False]
    assert "of anna, ben, carla have" in answers[2].reason
    assert list(handler.desired.objects) == ["anna", "ben"]

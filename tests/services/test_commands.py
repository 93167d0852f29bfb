"""Laws of commands: each is answered once, and what was asked for last holds, in every order."""

from __future__ import annotations

import itertools

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from catstream.box import Box
from catstream.detection.detector import Detector
from catstream.messages import Command
from catstream.services.commands import STOPPED, CommandHandler
from catstream.services.desired import DesiredState
from catstream.settings import Settings
from catstream.video.demo import render
from catstream.video.frames import Frame

((IMAGE, TRUTH),) = render(1, (160, 120))
BOXES = [Box(40, 30, 20, 20), Box(400, 30, 20, 20)]  # the second is outside of the frame


class Steering(RuleBasedStateMachine):
    """A handler, the commands that it was given, and what they should have led to."""

    def __init__(self):
        super().__init__()
        self.detector = Detector(Settings(teaching={"copies": 0}))
        self.handler = CommandHandler(self.detector, DesiredState())
        self.ids = map(str, itertools.count())
        self.open, self.paused, self.stopped, self.box = set(), False, False, None

    def give(self, verb, box=None, keep=False):
        command = Command(next(self.ids), verb, box, keep)
        self.open.add(command.id)
        return self.answered(self.handler.carry_out([command]))

    def answered(self, answers):
        for answer in answers:
            self.open.remove(answer.id)  # KeyError: answered twice
        return answers

    @rule(verb=st.sampled_from(["pause", "resume"]))
    def pause_or_resume(self, verb):
        (answer,) = self.give(verb)
        assert answer.done != self.stopped
        self.paused = self.paused if self.stopped else verb == "pause"

    @rule(box=st.sampled_from(BOXES), keep=st.booleans())
    def set_box(self, box, keep):
        answers = self.give("set-box", box, keep)
        assert bool(answers) == self.stopped
        assert not any(answer.done for answer in answers)

    @precondition(lambda self: self.detector.seq < 4)
    @rule()
    def next_frame(self):
        found, answers = self.handler.begin(Frame(self.detector.seq, 0.0, IMAGE))
        done = [answer for answer in self.answered(answers) if answer.done]
        assert len(done) == (found is not None)
        if found is not None:
            self.box = self.handler.desired.box
            assert found[0].seq == self.handler.desired.begins == self.detector.seq
            assert self.box == BOXES[0]

    @rule()
    def save(self):
        (answer,) = self.give("save")
        assert not answer.done
        assert "nothing was learned" in answer.reason

    @rule()
    def lose_the_source(self):
        assert not any(answer.done for answer in self.answered(self.handler.reject_boxes("it is lost")))
        assert not self.open

    @precondition(lambda self: self.detector.seq)
    @rule()
    def stop(self):
        self.give("stop")
        self.stopped = True
        assert not self.open

    @invariant()
    def the_desired_state_is_what_was_asked_for_last(self):
        desired = self.handler.desired
        assert (desired.paused, desired.stopped, desired.box) == (self.paused, self.stopped, self.box)
        assert self.handler.end_reason == (STOPPED if self.stopped else "")
        assert len(self.open) == 0 or self.handler.has_box


TestSteering = Steering.TestCase
TestSteering.settings = settings(max_examples=30, stateful_step_count=12)


def test_a_handler_that_is_released_forgets_that_it_was_stopped():
    handler = CommandHandler(Detector(Settings()), DesiredState(BOXES[0], begins=1))
    handler.carry_out([Command("1", "stop")])
    assert handler.desired.stopped
    handler.clear_stop()
    assert handler.desired == DesiredState(BOXES[0], begins=1)
    assert handler.end_reason == STOPPED

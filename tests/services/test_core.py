"""Laws of the detector's core: in every order of events, and if the process is killed at any of them."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from msgspec.structs import replace

from catstream.box import Box, Window
from catstream.messages.kinds import Command, DetectorState, ObjectPosition, Position
from catstream.services import actions, core
from catstream.services.core import History, handle
from catstream.services.core_state import STOPPED, Known, Phase, Progress, Request, Rules, Saved, State
from catstream.services.desired import DesiredObject, DesiredState, PastObject

BOX, FIRST, OUTSIDE = Box(40, 30, 20, 20), Box(10, 30, 20, 20), Box(400, 30, 20, 20)
PLACE = Window(40, 30, 20, 20)
SAVED = Saved("digest", BOX, version=5, size=1000)
NAMES = ["", "anna", "ben", "carl"]
RULES = Rules(window=3, lag_frames=2, lockstep=False, objects_most=2, context=1.0)
ANNA = DesiredState({"anna": DesiredObject(FIRST, 1)})


def at(version, box=None, has_state=False, is_sought=False):
    """The part of a position for one object, with a state of its detector or without."""
    state = DetectorState(0, "weak", PLACE, PLACE, None if is_sought else PLACE, centre=np.eye(5, 4))
    return ObjectPosition(box, version, state if has_state else None)


class Receiver:
    """The compressor or the owner of the run, and the messages on their way to it."""

    def __init__(self):
        self.sent = self.taken = self.acknowledged = self.ended = 0
        self.on_the_way = []

    @property
    def limit(self):
        room = self.sent - min(self.acknowledged, self.sent) < RULES.window
        return self.sent + room

    def resume(self, seq):
        self.sent, self.on_the_way = seq, []

    def send(self, seq, end):
        assert seq == self.sent + 1, "messages are sent in order, each once"
        assert seq <= self.limit, "never beyond the window"
        self.sent = seq
        self.on_the_way.append((seq, end))

    def receive(self):
        seq, end = self.on_the_way.pop(0)
        if seq == self.taken + 1 or (end and not self.ended and seq <= self.taken):
            assert not self.ended, "nothing follows the end"
            self.taken, self.ended = max(seq, self.taken), end


class World:
    """A process around the core, without frames: what it sends, what is stored, and how commands are answered."""

    def __init__(self, rules=RULES, desired=DesiredState()):  # noqa: B008
        self.rules, self.stored = rules, desired
        self.receivers = {"features": Receiver(), "results": Receiver()}
        self.messages = {}  # the objects of each message
        self.samples = []  # message that led to it, object, version; the newest last
        self.answers, self.history = {}, History(State.at_start(rules, desired))
        self.detectors, self.given, self.given_up = {}, set(), []
        self.begun, self.finished = {}, False
        self.tell(core.Subscribed(False, True, 0.0))

    @property
    def state(self):
        return self.history.state

    def tell(self, event):
        events = [event]
        while events:
            for action in self.history.handle(events.pop(0)):
                if (result := getattr(self, type(action).__name__)(action)) is not None:
                    events.append(result)

    def command(self, verb, name="", box=None, keep=False, **request):
        """The answer, None if it follows with a frame."""
        command = Command(f"{len(self.answers)}-{next(IDS)}", verb, box, keep, name)
        self.answers[command.id] = None
        self.tell(core.Commanded(Request(command, **request)))
        return self.answers[command.id]

    def frame(self, live=False):
        self.tell(core.Frame(self.state.seq, live))

    def progress(self):
        """Tell how far the receivers are."""
        self.tell(core.Progressed(self.progress_of(self.state.due)))

    def progress_of(self, due):
        features, results = self.receivers["features"], self.receivers["results"]
        samples = {name: version for seq, name, version in self.samples if seq <= due}
        both = (
            (min(each.acknowledged, each.sent), min(each.taken, each.sent), each.limit) for each in (features, results)
        )
        return Progress(*itertools.chain(*both), due, samples)

    def receive_all(self):
        for receiver in self.receivers.values():
            while receiver.on_the_way:
                receiver.receive()
            receiver.acknowledged = receiver.taken
        self.progress()

    def learn(self, name):
        """The compressor makes a sample of an object from the newest features; the model follows later."""
        versions = [version for _, _, version in self.samples]
        self.samples.append((self.receivers["features"].taken, name, max(versions, default=0) + 1))

    def model(self, name):
        """The newest model of an object arrives."""
        version = max((version for _, of, version in self.samples if of == name), default=0)
        if name in self.detectors and version:
            known = self.detectors[name] = replace(self.detectors[name], version=version, newest=version)
            self.tell(core.ModelArrived(name, version, known))

    def kill(self):
        """The process is killed, and another one continues; the receivers answer it, and the newest models arrive."""
        self.history = History(State.at_start(replace(self.rules, resumes=True), self.stored))
        self.detectors, self.given, self.finished = {}, set(), False
        self.tell(core.Subscribed(False, True, 0.0))
        newest = {name: version for _, name, version in self.samples}
        names = ("features", "results") if self.rules.owned else ("features",)
        places = []
        for receiver in map(self.receivers.__getitem__, names):
            seq = receiver.taken - bool(receiver.ended)
            of = {name: at(newest.get(name, 0), BOX, True) for name in self.messages.get(seq, ())}
            places.append(Position(seq, seq, of))
        for name, version in newest.items():
            self.tell(core.Positions(tuple(places)))
            if self.state.phase is Phase.POSITIONS:
                self.tell(core.ModelArrived(name, version))
        if self.state.phase is Phase.POSITIONS:
            self.tell(core.Positions(tuple(places)))

    # The actions

    def Continue(self, order):
        newest = {name: version for _, name, version in self.samples}
        version = newest[order.name]
        self.detectors[order.name] = Known(version, version, order.began, bool(order.model), PLACE)

    def Resume(self, order):
        for receiver in self.receivers.values():
            receiver.resume(order.seq)
        return core.Resumed(dict(self.detectors))

    def SetBox(self, order):
        if order.box == OUTSIDE:
            return core.Begun(error="the box lies outside the frame")
        if not order.keep:
            self.Begin(order)
        self.given.add(order.name)
        return core.Begun(self.detectors[order.name])

    def Forget(self, order):
        del self.detectors[order.name]

    def Begin(self, order):
        self.detectors.pop(order.name, None)
        self.detectors[order.name] = Known(0, 0, self.state.seq, False, PLACE)
        self.given.add(order.name)

    def Seek(self, order):
        assert order.model
        self.detectors.pop(order.name, None)
        self.detectors[order.name] = Known(SAVED.version, SAVED.version, order.began, True, PLACE)

    def Miss(self, order):
        assert order.name not in self.detectors
        self.given.add(order.name)

    def Step(self, _):
        seq, names = self.state.seq + 1, {*self.detectors, *self.given}
        assert self.messages.setdefault(seq, names) == names, "a frame is repeated with the objects of that frame"
        if not self.state.live and self.state.stopping < 0:
            due = self.state.due
            assert min(self.receivers["features"].taken, self.receivers["features"].sent) >= due
            for made, name, version in self.samples:
                if made <= due and name in self.detectors and self.detectors[name].began < due:
                    assert self.detectors[name].newest >= version, "never further ahead than the lag"
        self.given = set()
        return core.Stepped(dict(self.detectors), self.progress_of(self.state.due + 1))

    def Send(self, order):
        assert order.seq == self.state.seq + bool(order.end)
        if order.channel == "features" and self.rules.lockstep and self.rules.owned and self.state.stopping < 0:
            assert self.receivers["results"].taken >= self.state.seq, "in lockstep the owner is never behind"
        self.receivers[order.channel].send(order.seq, order.end)

    def GiveUp(self, order):
        assert self.state.stopping >= 0, "only if the process is to end"
        self.given_up.append((order.channel, order.seq))

    def Show(self, _):
        pass

    def Conclude(self, order):
        self.stored = self.state.desired
        for answer in order.answers:
            assert self.answers[answer.id] is None, "each command is answered once"
            self.answers[answer.id] = answer

    def Finish(self, _):
        self.finished = True


IDS = itertools.count()
channels = st.sampled_from(["features", "results"])
names = st.sampled_from(NAMES)


class Anything(RuleBasedStateMachine):
    """Whatever happens in whatever order."""

    @initialize(lockstep=st.booleans(), owned=st.booleans(), live=st.booleans())
    def begin(self, lockstep, owned, live):
        lag = 0 if lockstep else RULES.lag_frames
        self.live = live
        self.world = World(replace(RULES, lockstep=lockstep, lag_frames=lag, owned=owned), ANNA)
        self.objects, self.paused, self.stopped = dict(ANNA.objects), False, False
        self.signalled = self.ended = False

    def meant(self, name):
        """The object that a name stands for, None if that is not clear."""
        if name or not self.objects or "" in self.objects:
            return name
        return None if len(self.objects) > 1 else next(iter(self.objects))

    @property
    def repeats(self):
        return self.world.state.is_repeating

    @precondition(lambda self: self.world.state.phase is Phase.FRAME)
    @rule()
    def frame(self):
        seq = self.world.state.seq
        self.world.frame(self.live)
        for name, each in self.world.state.desired.objects.items():
            if each.begins == seq + 1 and self.objects.get(name) != each:  # of a box
                self.objects.pop(name, None)
                self.objects[name] = each

    @rule(channel=channels, acknowledges=st.booleans(), learns=st.none() | names)
    def receive(self, channel, acknowledges, learns):
        receiver, before = self.world.receivers[channel], self.world.receivers["features"].taken
        if receiver.on_the_way:
            receiver.receive()
        if acknowledges:
            receiver.acknowledged = receiver.taken
        taken = self.world.receivers["features"].taken
        if taken > before and learns in self.world.messages.get(taken, ()):
            self.world.learn(learns)
        self.world.progress()

    @rule(name=names)
    def model(self, name):
        self.world.model(name)

    @precondition(lambda self: not self.repeats)
    @rule(name=names, box=st.sampled_from([BOX, OUTSIDE]), keep=st.booleans())
    def set_box(self, name, box, keep):
        held = self.world.state.phase is Phase.HELD
        answer = self.world.command("set-box", name, box, keep)
        if self.stopped or self.ended:
            assert answer is not None
            assert not answer.done
        elif held and answer is not None and answer.done and not answer.reason.startswith("the same object"):
            self.objects.pop(answer.object, None)
            self.objects[answer.object] = DesiredObject(BOX, answer.frame + 1)

    @precondition(lambda self: not self.repeats)
    @rule(name=names, damaged=st.booleans())
    def search(self, name, damaged):
        meant, seq = self.meant(name), self.world.state.seq
        answer = self.world.command("search", name, **({"error": "it is damaged"} if damaged else {"saved": SAVED}))
        room = meant is not None and len(self.objects.keys() | {meant}) <= RULES.objects_most
        assert answer.done == (room and not damaged and not self.stopped and not self.ended)
        if answer.done:
            self.objects.pop(meant, None)
            self.objects[meant] = DesiredObject(BOX, seq + 1, SAVED.name, SAVED.size)

    @precondition(lambda self: not self.repeats)
    @rule(name=names)
    def forget(self, name):
        meant = self.meant(name)
        answer = self.world.command("forget", name)
        assert answer.done == (meant in self.objects and not self.stopped and not self.ended)
        if answer.done:
            assert answer.object == meant
            del self.objects[meant]

    @rule(verb=st.sampled_from(["pause", "resume"]))
    def pause_or_resume(self, verb):
        answer = self.world.command(verb)
        assert answer.done != (self.stopped or self.ended)
        self.paused = verb == "pause" if answer.done else self.paused

    @precondition(lambda self: not self.repeats)
    @rule(name=names)
    def save(self, name):
        answer = self.world.command("save", name)
        assert not answer.done or self.world.state.known[answer.object].version

    @precondition(lambda self: self.world.state.seq and not self.ended)
    @rule()
    def stop(self):
        self.world.command("stop")
        self.stopped = True

    @rule()
    def lose_the_source(self):
        self.world.tell(core.SourceLost())
        assert not self.world.state.boxes

    @rule(seconds=st.sampled_from([0.0, 0.7, 20.0]))
    def signal(self, seconds):
        self.signalled = True
        self.world.tell(core.Stopping(max(seconds, self.world.state.stopping)))

    @precondition(lambda self: self.world.state.phase is Phase.FRAME)
    @rule(failed=st.booleans())
    def end(self, failed):
        """A source may fail while frames of an earlier detector are repeated."""
        self.ended = True
        self.world.tell(core.Ended("the source has ended", failed))

    @precondition(lambda self: self.world.samples and not self.ended and not self.world.state.boxes)
    @rule()
    def kill(self):
        """The receivers are behind the detector: what is on the way is lost."""
        self.world.answers = {id: each for id, each in self.world.answers.items() if each is not None}
        self.world.kill()
        assert self.world.state.phase is Phase.FRAME
        self.objects = dict(self.world.state.desired.objects)

    @invariant()
    def the_last_command_of_each_kind_holds(self):
        desired = self.world.state.desired
        assert (desired.paused, desired.stopped) == (self.paused, self.stopped and not self.world.finished)
        assert list(desired.objects.items()) == list(self.objects.items())
        assert len(self.objects) <= RULES.objects_most
        assert self.world.stored == desired, "what is answered is stored"

    @invariant()
    def a_command_is_answered_unless_it_waits(self):
        waiting = {each.id for each in self.world.state.boxes} | {r.command.id for r in self.world.state.waiting}
        assert {id for id, answer in self.world.answers.items() if answer is None} == waiting

    @invariant()
    def the_state_is_small_and_may_be_written(self):
        state = self.world.state
        assert msgspec.json.decode(msgspec.json.encode(state), type=State) == state

    def teardown(self):
        """Whatever happened, the stream can be ended; and then everybody has everything, unless it was given up."""
        if not hasattr(self, "world"):
            return
        world = self.world
        if self.paused and not self.ended and not self.stopped:
            world.command("resume")
        for _ in range(99):
            if world.state.phase is Phase.HELD:  # no object is left
                world.command("set-box", "", BOX)
            if world.state.phase is Phase.FRAME and self.repeats and not world.state.end_reason:
                world.frame(self.live)  # the source has all frames that were tracked
            if world.state.phase is Phase.FRAME:
                world.tell(core.Ended("the source has ended"))
            world.receive_all()
            for name in NAMES:
                world.model(name)
        assert world.state.phase is Phase.ENDED
        assert world.finished or self.signalled
        assert None not in world.answers.values()
        owed = ["features", *(["results"] if world.rules.owned else [])]
        for name in owed if world.finished and not world.given_up else ():
            assert world.receivers[name].taken >= world.state.seq + 1
            assert world.receivers[name].ended


TestAnything = Anything.TestCase
TestAnything.settings = settings(max_examples=150, stateful_step_count=40)


@pytest.fixture
def two():
    """A run of the objects anna and ben, which began in its first frame by commands."""
    world = World()
    for name in ("anna", "ben"):
        world.command("set-box", name, BOX)
    world.frame()
    world.receive_all()
    assert world.state.phase is Phase.FRAME
    return world


def reply(world, *arguments, **more):
    """The answer to a command, after the next frame if that is needed, as done and reason."""
    before = set(world.answers)
    if world.command(*arguments, **more) is None:
        world.frame()
        world.receive_all()
    answer = next(each for id, each in world.answers.items() if id not in before)
    return answer.done, answer.reason


def test_two_boxes_for_two_objects_begin_them_in_one_frame(two):
    assert two.messages == {1: {"anna", "ben"}}
    assert [answer.reason for answer in two.answers.values()] == [
        f"the object {name} begins at {BOX} in frame 0" for name in ("anna", "ben")
    ]


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (("set-box", "carl", BOX), "3 objects are more than 2: follow fewer"),
        (("set-box", "anna", OUTSIDE), "the box lies outside the frame"),
        (("set-box", "", BOX), "which object? This run has anna, ben: give a name"),
        (("forget",), "which object? This run has anna, ben: give a name"),
        (("forget", "carl"), "there is no object 'carl': the objects are anna, ben"),
        (("save", "anna"), "nothing was learned of the object yet"),
        (("forget", "an na"), "is not a name"),
    ],
    ids=str,
)
def test_a_command_that_cannot_be_carried_out_is_rejected_with_the_reason_and_changes_nothing(two, command, why):
    before = two.state.desired
    done, reason = reply(two, *command)
    assert not done
    assert why in reason
    assert two.state.desired == before


def test_a_saved_model_that_cannot_be_used_is_rejected_with_the_reason(two):
    assert reply(two, "search", "anna", error="it is damaged") == (False, "it is damaged")
    done, reason = reply(two, "search", "carl", saved=SAVED)
    assert (done, reason) == (
        False,
        "3 objects are more than 2: follow fewer, or raise the limit (--set run.objects_most=3, up to 64)",
    )


def test_a_saved_model_that_is_too_large_for_the_message_of_a_frame_is_refused_and_the_run_goes_on(monkeypatch):
    monkeypatch.setattr("catstream.run.learned.LARGEST_GIVEN_MODELS", 2 * SAVED.size)
    world = World(replace(RULES, objects_most=3))
    named = [(name, replace(SAVED, name=f"of {name}")) for name in ("anna", "ben", "carla")]
    answers = [reply(world, "search", name, saved=saved) for name, saved in named]
    assert [done for done, _ in answers] == [True, True, False]
    assert "of anna, ben, carla have" in answers[2][1]
    assert list(world.state.desired.objects) == ["anna", "ben"]


def test_a_box_for_the_name_of_an_object_begins_another_object_of_that_name(two):
    assert reply(two, "set-box", "anna", BOX) == (True, f"another object anna begins at {BOX} in frame 1")
    assert two.state.desired.objects["anna"].begins == 2
    assert two.state.desired.past == (PastObject("anna", DesiredObject(BOX, 1), 1),)


def test_a_box_for_the_same_object_keeps_what_was_learned_of_it(two):
    two.learn("anna")
    two.model("anna")
    before = two.state.desired
    assert reply(two, "set-box", "anna", BOX, True) == (True, f"the same object anna continues at {BOX} in frame 1")
    assert reply(two, "set-box", "ben", BOX, True) == (True, f"another object ben begins at {BOX} in frame 2")
    assert two.state.desired.objects["anna"] == before.objects["anna"]
    assert two.state.known["anna"].version == 1


def test_another_object_of_the_name_keeps_nothing_of_the_one_before(two):
    two.learn("anna")
    two.model("anna")
    two.command("search", "anna", saved=SAVED)
    assert reply(two, "set-box", "anna", BOX, True) == (True, f"another object anna begins at {BOX} in frame 1")


def test_of_two_boxes_for_one_name_the_second_waits_for_the_frame_after(two):
    for _ in range(2):
        two.command("set-box", "anna", BOX)
    two.frame()
    assert len(two.state.boxes) == 1
    two.receive_all()
    two.frame()
    assert [each.begins for each in (two.state.desired.objects["anna"], two.state.desired.past[-1].each)] == [3, 2]


def test_once_the_last_object_was_forgotten_a_paused_run_waits_for_a_box(two):
    reply(two, "pause")
    assert reply(two, "forget", "ben") == (True, "ben is no longer tracked after frame 0")
    waits = "anna is no longer tracked after frame 0: no object is left, so the run waits for a box"
    assert reply(two, "forget") == (True, waits)
    assert not two.detectors
    assert reply(two, "resume") == (True, "waiting for a box")
    assert "no object is tracked yet" in reply(two, "forget")[1]
    assert reply(two, "set-box", "anna", BOX)[0]
    assert not two.state.desired.holds


@pytest.fixture
def repeating():
    """A restarted detector whose compressor has stored one message, and whose owner has all three."""
    world = World(replace(RULES, owned=True), ANNA)
    for _ in range(3):
        world.frame()
        world.receivers["results"].receive()
        world.receivers["features"].receive()
        world.learn("anna")
        world.model("anna")
        world.progress()
    world.receivers["features"].taken, world.receivers["results"].acknowledged = 1, 3
    world.samples = world.samples[:1]
    world.kill()
    assert (world.state.phase, world.state.seq, world.state.is_repeating) == (Phase.FRAME, 1, True)
    return world


def test_commands_for_objects_wait_until_all_frames_of_an_earlier_detector_are_repeated(repeating):
    assert repeating.command("forget", "anna") is None
    assert repeating.command("pause").reason == "paused after the last frame that was tracked before the restart"
    for _ in range(2):  # are repeated, though the run is paused
        repeating.frame()
        repeating.receive_all()
    assert next(answer.reason for answer in repeating.answers.values()) == (
        "anna is no longer tracked after frame 2: no object is left, so the run waits for a box"
    )
    assert repeating.state.desired.past == (PastObject("anna", DesiredObject(FIRST, 1), 3),)


@pytest.mark.parametrize("killed", [False, True])
def test_a_stop_takes_effect_once_all_frames_of_an_earlier_detector_are_repeated(repeating, killed):
    assert repeating.command("stop").reason == (
        "the stream ends after the last frame that was tracked before the restart"
    )
    if killed:
        repeating.kill()
    for seq in (2, 3):
        assert not repeating.state.end_reason
        repeating.frame()
        repeating.receive_all()
        assert repeating.state.seq == seq
    assert repeating.state.end_reason == STOPPED
    repeating.tell(core.Ended("the source has ended"))
    for _ in repeating.receivers:  # the end is sent to one after the other
        repeating.receive_all()
    assert repeating.finished
    for receiver in repeating.receivers.values():
        assert (receiver.taken, receiver.ended) == (4, True), "the end follows the last message that a receiver has"


def test_a_repeated_frame_reports_an_object_as_absent_that_was_forgotten_later_and_of_which_nothing_is_known():
    desired = ANNA.begun("ben", DesiredObject(BOX, 1)).without("ben", 3)
    world = World(desired=desired)
    world.history = History(State.at_start(replace(RULES, resumes=True), desired))
    world.tell(core.Subscribed(False, True, 0.0))
    world.tell(core.ModelArrived("anna", 1))
    world.samples.append((1, "anna", 1))
    world.tell(core.Positions((Position(1, 0, {"anna": at(1, BOX, True)}),)))
    for _ in range(3):
        world.frame()
        world.receivers["features"].acknowledged = world.receivers["features"].taken = world.state.seq
        world.progress()
    assert world.messages == {2: {"anna", "ben"}, 3: {"anna", "ben"}, 4: {"anna"}}


@given(st.integers(0, 5), st.integers(1, 5), st.integers(0, 3), st.integers(0, 3))
def test_a_model_is_awaited_for_an_object_that_had_begun_and_whose_sample_is_newer(began, due, newest, version):
    known = {"anna": Known(newest, newest, began, False, PLACE)}
    progress = Progress(due, due, due=due, samples={"anna": version, "ben": 9})
    state = State(RULES, Phase.TAKEN, seq=due + RULES.lag_frames, desired=ANNA, known=known)
    state, _ = handle(state, core.Progressed(progress))
    assert (state.phase is Phase.MODEL) == (began < due and newest < version)


def test_a_stop_holds_until_the_end_of_the_stream_is_stored():
    world = World(desired=ANNA)
    world.command("stop")
    assert world.state.end_reason == STOPPED
    world.tell(core.Ended("the source has ended"))
    assert world.state.ending == STOPPED
    assert world.stored.stopped
    world.progress()
    world.receive_all()
    assert world.finished
    assert world.stored == ANNA


def test_an_event_that_cannot_happen_is_an_error():
    with pytest.raises(ValueError, match="Stepped is not expected while the detector waits until the next frame"):
        handle(World(desired=ANNA).state, core.Stepped({}, Progress()))


@given(st.integers(0, 9), st.sampled_from(["features", "results"]), st.floats(0, 30))
def test_the_end_is_given_up_only_after_the_process_was_asked_to_end_and_its_patience_is_over(seq, slow, seconds):
    state = State(replace(RULES, owned=True), Phase.FRAME, seq=seq, desired=ANNA)
    state, _ = handle(state, core.Progressed(Progress(seq, seq, seq + 1, seq, seq, seq + 1)))
    state, found = handle(state, core.Ended("the source has ended"))
    assert [order for order in found if isinstance(order, actions.Send)] == [actions.Send("features", seq + 1, True)]
    if slow == "results":
        state, _ = handle(state, core.Progressed(Progress(seq + 1, seq + 1, seq + 2, seq, seq, seq + 1)))
    waits = state.phase
    state, _ = handle(state, core.Stopping(seconds))
    patience = {"features": 10.0, "results": 0.5}[slow]
    assert (state.phase is waits) == (seconds < patience)


# The position at which a process continues

seqs, versions = st.integers(0, 50), st.integers(0, 9)
parts = st.builds(at, versions, st.none() | st.just(BOX), st.booleans(), st.booleans())
places = st.lists(st.builds(Position, seqs, seqs, st.dictionaries(names, parts)), min_size=1, max_size=2)
objects = st.builds(DesiredObject, st.just(BOX), seqs.filter(bool), st.sampled_from(["", "a saved model"]))
states = st.builds(DesiredState, st.dictionaries(names, objects))


def resumed(desired, positions, models=None):
    """The state and the actions after the answers of the receivers; the models are by default those that are needed."""
    models = {name: part.version for name, part in positions[0].objects.items()} if models is None else models
    state = State(replace(RULES, resumes=True), Phase.POSITIONS, desired=desired, arrived=models)
    return handle(state, core.Positions(tuple(positions)))


def of_kind(found, kind):
    return {order.name: order for order in found if isinstance(order, kind)}


@given(states, places)
def test_no_receiver_misses_a_message(desired, positions):
    state, found = resumed(desired, positions)
    (seq,) = [order.seq for order in found if isinstance(order, actions.Resume)]
    assert seq == state.seq
    assert 0 <= seq <= min(place.seq for place in positions)
    begun = {each.begins for each in desired.objects.values()}
    assert seq + 1 in {min(place.seq for place in positions) + 1, *begun}
    assert state.repeats == max(place.seq for place in positions)


@given(states, places)
def test_a_detector_continues_only_if_something_was_learned_and_after_its_object_has_begun(desired, positions):
    state, found = resumed(desired, positions)
    for name, order in of_kind(found, actions.Continue).items():
        assert any(place.seq == state.seq and place.objects[name] is order.at for place in positions)
        assert positions[0].objects[name].version
        assert order.at.detector or order.at.box
        assert order.began < desired.objects[name].begins <= state.seq


@given(states, places)
def test_every_object_that_was_wanted_is_still_wanted_and_continues_or_begins_later(desired, positions):
    state, found = resumed(desired, positions)
    assert state.desired.objects.keys() == desired.objects.keys()
    goes_on = of_kind(found, (actions.Continue, actions.Seek))
    for name, each in state.desired.objects.items():
        assert name in goes_on or each.begins > state.seq


@given(states, places)
def test_if_nothing_was_learned_of_any_object_all_begin_at_their_first_frames(desired, positions):
    if not any(part.version for part in positions[0].objects.values()) and desired.objects:
        state, found = resumed(desired, positions)
        assert state.seq < min(each.begins for each in state.desired.objects.values())
        assert not of_kind(found, actions.Continue)


@given(states, places, st.dictionaries(names, versions.filter(bool)))
def test_compressor_and_trainer_agree_once_the_model_of_every_sample_is_here(desired, positions, models):
    last = min(place.seq for place in positions)
    there = {name for name, each in desired.objects.items() if each.begins <= last}
    expected = all(
        models.get(name) == part.version
        for name, part in positions[0].objects.items()
        if part.version and name in there
    )
    state, _ = resumed(desired, positions, models)
    assert (state.phase is Phase.RESUME) == expected


def test_an_object_that_had_learned_nothing_beside_another_begins_anew_where_it_was_last():
    last = Box(5, 6, 30, 40)
    place = Position(5, 4, {"anna": at(1, BOX, True), "ben": at(0, last)})
    state, found = resumed(DesiredState({name: DesiredObject(BOX, 2) for name in ("anna", "ben")}), [place])
    assert list(of_kind(found, actions.Continue)) == ["anna"]
    assert state.desired.objects["ben"] == DesiredObject(last, begins=6)


def test_an_object_that_was_forgotten_later_continues_until_then_in_the_order_of_the_trees():
    place = Position(5, 4, dict.fromkeys(["anna", "ben"], at(1, BOX, True)))
    first, ben, second = (DesiredObject(BOX, begins) for begins in (1, 2, 9))
    desired = DesiredState().begun("anna", first).begun("ben", ben).without("anna", 8).begun("anna", second)
    state, found = resumed(desired, [place])
    assert list(of_kind(found, actions.Continue)) == ["anna", "ben"]
    assert state.desired == desired


def test_the_object_of_a_saved_model_is_still_searched_for_unless_it_was_found():
    desired = DesiredState({name: DesiredObject(BOX, 1, "a saved model") for name in ("anna", "ben", "carl")})
    found_and_sought = {"anna": at(1, BOX, True), "ben": at(1, None, True, is_sought=True)}
    position = Position(5, 4, found_and_sought | {"carl": at(1)})
    _, found = resumed(desired, [position])
    models = {name: order.model for name, order in of_kind(found, actions.Continue).items()}
    assert models == {"anna": "", "ben": "a saved model"}
    assert of_kind(found, actions.Seek) == {"carl": actions.Seek("carl", "a saved model", 0, again=True)}


# The file of events


def replayed(history, file):
    """The number of events in the file, and the state after them; fails unless they lead to the same actions again."""
    history.write(file)
    state, steps = History.read(file)
    for event, orders in steps:
        state, found = handle(state, event)
        assert msgspec.json.decode(msgspec.json.encode(found, enc_hook=np.ndarray.tolist)) == orders
    return len(steps), state


def test_the_last_events_are_written_and_lead_to_the_same_actions_again(two, tmp_path):
    for number in range(400):
        reply(two, "pause" if number % 2 else "resume")
        two.command("search", "anna", saved=SAVED)
        two.frame()
        two.receive_all()
    assert replayed(two.history, tmp_path / "events.ndjson") == (1000, two.state)


def test_the_positions_of_the_receivers_are_written_with_the_states_of_the_detectors(repeating, tmp_path):
    assert replayed(repeating.history, tmp_path / "events.ndjson")[1] == repeating.state


def test_an_event_that_leads_to_an_error_is_written_too(two, tmp_path):
    with pytest.raises(ValueError, match="is not expected"):
        two.tell(core.Begun())
    two.history.write(tmp_path / "events.ndjson")
    assert History.read(tmp_path / "events.ndjson")[1][-1] == (core.Begun(), [])

"""The fencing law of the states of a stream: random histories with pauses, lost answers, half writes, and kills."""

import json
import queue
import threading

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from catstream.errors import FencedError, StoreError
from catstream.fleet.store import Claim, StateStore

FOLDER = "streams/cam-7"
PROCESSES = st.integers(0, 2)
KINDS = st.sampled_from(["claim", "write", "read"])
CALLS = ("create", "read", "names", "remove")

#: What may become of a call that creates an object; every other call is done, or fails.
FAULTS = ("done", "done", "done", "failed", "lost", "repeated", "half", "late")


class Killed(BaseException):
    """Ends the thread of a process that was killed."""


class Memory:
    """Objects in memory, which record the claims that were ever stored."""

    def __init__(self):
        self.objects = {}
        self.claims = set()
        self.late = []

    def create(self, name, data):
        if name in self.objects:
            raise FileExistsError(name)
        self.objects[name] = data
        token, _, rest = name.removeprefix(f"{FOLDER}/").partition("/")
        if rest == "claim":
            self.claims.add(int(token))

    def read(self, name):
        try:
            return self.objects[name]
        except KeyError:
            raise FileNotFoundError(name) from None

    def names(self, folder):
        return [name.removeprefix(f"{folder}/") for name in self.objects]

    def remove(self, name):
        self.objects.pop(name, None)

    def land(self, index):
        """Store an object whose writer has long given up."""
        name, data = self.late.pop(index)
        if name not in self.objects:
            self.create(name, data)


class Process:
    """Runs a task in a thread that waits before each call of the store, so that a test decides when and how it ends."""

    def __init__(self, memory):
        self.memory = memory
        self.claim, self.chain = None, ()
        self.task = None

    def begin(self, kind, task):
        """Start a task; return whether it is over."""
        self.kind, self.task = kind, task
        self.orders, self.stops = queue.SimpleQueue(), queue.SimpleQueue()
        threading.Thread(target=self._run, daemon=True).start()
        return self.stops.get()

    def step(self, fault):
        """Let the waiting call end so; return whether the task is over."""
        self.orders.put(fault)
        return self.stops.get()

    def _run(self):
        try:
            self.result = self.task(StateStore(self, FOLDER))
        except (StoreError, FencedError) as error:
            self.result = error
        except Killed:
            self.result = None
        self.task = None
        self.stops.put(True)

    def _wait(self, call):
        self.pending = call
        self.stops.put(False)
        fault = self.orders.get()
        if fault == "killed":
            raise Killed
        return fault

    def create(self, name, data):
        fault = self._wait("create")
        if fault == "late":
            self.memory.late.append((name, data))
        elif fault != "failed":
            self.memory.create(name, data[: len(data) // 2] if fault == "half" else data)
        if fault == "repeated":  # the client lost the answer, and sent the request again
            raise FileExistsError(name)
        if fault != "done":
            raise StoreError(fault)

    def __getattr__(self, name):
        if name not in CALLS:
            raise AttributeError(name)

        def call(*arguments):
            if self._wait(name) not in ("done", "repeated"):
                raise StoreError(name)
            return getattr(self.memory, name)(*arguments)

        return call


def chain(state):
    """The writes that a state contains: (token, serial) of each."""
    return tuple(map(tuple, json.loads(state.files["chain"]))) if state else ()


class Fencing(RuleBasedStateMachine):
    """Three processes claim, write and read the states of a stream. A state contains all writes that led to it.

    A write is durable if it was acknowledged when no later claim was stored.
    """

    def __init__(self):
        super().__init__()
        self.memory = Memory()
        self.processes = [Process(self.memory) for _ in range(3)]
        self.durable = set()
        self.newest_claim = 0  # token of the newest acknowledged one
        self.written = ()  # the writes that led to the newest durable one
        self.serial = 0

    def teardown(self):
        for number in range(3):
            self.kill(number)

    @initialize()
    def there_is_a_holder(self):
        self.claim_and_write(0)

    @rule(number=PROCESSES, kind=KINDS, call=st.sampled_from(CALLS), skipped=st.integers(0, 1))
    def pause(self, number, kind, call, skipped):
        """Begin a task that is paused before one of its calls of the store."""
        process = self.processes[number]
        if self.begin(process, kind):
            for turn in range(skipped + 1):
                if turn:
                    self.step(process, "done")
                self.run_until(process, call)

    @rule(number=PROCESSES, fault=st.sampled_from(FAULTS))
    def resume(self, number, fault):
        """Go on with a paused task, whose next call has a fault, to its end."""
        self.step(self.processes[number], fault)
        self.run_until(self.processes[number])

    @rule(number=PROCESSES, kind=KINDS, fault=st.sampled_from(FAULTS))
    def act(self, number, kind, fault):
        """A whole task; the creation of an object, if there is one, has a fault."""
        process = self.processes[number]
        if self.begin(process, kind):
            self.run_until(process, "create")
            self.resume(number, fault)

    @rule(number=PROCESSES, count=st.integers(1, 4))
    def write(self, number, count):
        """Write without a fault, which succeeds if there is no later claim."""
        process = self.processes[number]
        for _ in range(count):
            if self.run(process, "write"):
                assert process.result is None or self.is_superseded(process.claim)

    @rule(number=PROCESSES)
    def claim_and_write(self, number):
        """Claim and write without a fault, which succeeds after any history."""
        process = self.processes[number]
        if self.run(process, "claim"):
            assert isinstance(process.result, Claim)
            assert self.run(process, "write")
            assert process.result is None

    @rule(number=PROCESSES)
    def kill(self, number):
        process = self.processes[number]
        if process.task:
            process.step("killed")
        self.processes[number] = Process(self.memory)

    @precondition(lambda self: self.memory.late)
    @rule(data=st.data())
    def land(self, data):
        self.memory.land(data.draw(st.integers(0, len(self.memory.late) - 1)))

    def run(self, process, kind):
        """A whole task without a disturbance; False if the process has another one."""
        begun = self.begin(process, kind)
        self.run_until(process)
        return begun

    def run_until(self, process, call=None):
        while process.task and process.pending != call:
            self.step(process, "done")

    def begin(self, process, kind):
        """Begin a task, if the process has none."""
        if process.task or (kind == "write" and not process.claim):
            return False
        process.newest, process.before = self.newest_claim, set(self.durable)
        task = {"claim": lambda states: states.claim(), "read": lambda states: states.newest()}.get(kind)
        if kind == "write":
            self.serial += 1
            process.chain = (*process.chain, (process.claim.token, self.serial))
            files = {"chain": json.dumps(process.chain).encode()}
            task = lambda _: process.claim.write(files, {})  # noqa: E731
        if process.begin(kind, task):
            self.end(process)  # a fenced process raises its error without a call of the store
        return True

    def step(self, process, fault):
        if process.task and process.step(fault):
            self.end(process)

    def end(self, process):
        """Check the result of a task."""
        result = process.result
        if process.kind == "claim" and isinstance(result, Claim):
            assert result.token > process.newest
            process.claim, process.chain = result, chain(result.state)
            assert {write for write in self.durable if write[0] < result.token} <= set(process.chain)
            self.newest_claim = max(self.newest_claim, result.token)
        elif process.kind == "write" and result is None:
            assert process.newest <= process.claim.token, "a write succeeded that began after a newer claim had ended"
            if not self.is_superseded(process.claim):
                self.durable.add(process.chain[-1])
                self.written = process.chain
        elif process.kind == "read" and not isinstance(result, Exception):
            assert process.before <= set(chain(result))

    def is_superseded(self, claim):
        """Whether a later claim was ever stored."""
        return any(number > claim.token for number in self.memory.claims)

    @invariant()
    def the_newest_state_has_all_durable_writes_and_continues_the_last_of_them(self):
        newest = chain(StateStore(self.memory, FOLDER).newest())
        assert self.durable <= set(newest)
        assert newest[: len(self.written)] == self.written


def test_claim_fences_older_writers_and_loses_no_acknowledged_state():
    run_state_machine_as_test(Fencing, settings=settings(max_examples=200, stateful_step_count=20, deadline=None))


def test_late_write_does_not_restore_a_removed_stream():
    memory = Memory()
    states = StateStore(memory, FOLDER)
    claim = states.claim()
    claim.write({}, {})
    memory.late.append((f"{FOLDER}/00000001/00000002", memory.read(f"{FOLDER}/00000001/00000001")))
    states.clear()
    memory.land(0)
    assert states.newest() is None
    new = states.claim()
    assert (new.state, new.token) == (None, 3)
    new.write({}, {"frame": 1})
    assert states.newest().facts == {"frame": 1}

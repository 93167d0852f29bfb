"""The controller of a fleet, with a fake Ray: starts, stops, stored specs and answers."""

import sys
import threading
import time
import types
from dataclasses import replace
from importlib.machinery import ModuleSpec

import pytest

from catstream.client.registry import Registry
from catstream.errors import FleetError, SilenceError, StoreError
from catstream.fleet import controller as module
from catstream.fleet.controller import Controller
from catstream.fleet.spec import FleetSpec, StreamSpec, from_json
from catstream.fleet.store import StateStore, Store
from catstream.wire.keys import allow
from catstream.wire.messages import StreamStatus

GATE, ROOF = StreamSpec("gate", "demo:1"), StreamSpec("roof", "demo:2", cores=0.5)


class RayError(Exception):
    pass


class Call:
    """A call of an actor: its answer is known, or not yet."""

    def __init__(self, answer=None, error=None):
        self.answer, self.error = answer, error

    @property
    def is_over(self):
        return self.answer is not None or self.error is not None


class FakeActor:
    """The actor of a stream, which the test lets run."""

    def __init__(self, options, spec):
        self.options, self.spec = options, spec
        self.status, self.superseded, self.asked, self.restarted = None, False, [], 0
        self.unstored = ""  # why its last state cannot be stored
        for name in ("report", "stop"):
            setattr(self, name, types.SimpleNamespace(remote=lambda *given, name=name: self._called(name, given)))

    def _called(self, name, given):
        self.asked.append((name, *given))
        if name == "stop":
            return Call(self.unstored)
        return Call((self.status, self.superseded) if self.status else None)


class Ray(types.ModuleType):
    """As much of Ray as a controller uses."""

    def __init__(self):
        super().__init__("ray")
        self.__spec__ = ModuleSpec("ray", None)
        self.actors, self.started = {}, []
        self.has_restarted = False  # whether it has started the controller again
        self.util = types.ModuleType("ray.util")
        self.util.list_named_actors = lambda **_: [{"name": name, "namespace": "catstream"} for name in self.actors]
        self.exceptions = types.ModuleType("ray.exceptions")
        self.exceptions.RayError = RayError

    def get_runtime_context(self):
        return types.SimpleNamespace(was_current_actor_reconstructed=self.has_restarted)

    def remote(self, _):
        return types.SimpleNamespace(
            options=lambda **options: types.SimpleNamespace(remote=lambda *given: self._start(options, *given))
        )

    def _start(self, options, spec, *_):
        actor = self.actors[options["name"]] = FakeActor(options, spec)
        self.started.append(spec.name)
        return actor

    def of(self, name):
        """The actor of a stream."""
        (found,) = [actor for actor in self.actors.values() if actor.spec.name == name]
        return found

    def get_actor(self, name, **_):
        return self.actors[name]

    def wait(self, calls, **_):
        return [call for call in calls if call.is_over], []

    def get(self, call, **_):
        if call.error is not None:
            raise call.error
        return call.answer

    def kill(self, actor, no_restart=True):
        if no_restart:
            self.actors.pop(actor.options["name"], None)
        else:
            actor.restarted += 1


@pytest.fixture
def ray(monkeypatch):
    fake = Ray()
    for part in (fake, fake.util, fake.exceptions):
        monkeypatch.setitem(sys.modules, part.__name__, part)
    facts = {"NodeManagerAddress": "127.0.0.1", "Resources": {"CPU": 2.0}, "Alive": True}
    fake.nodes = [facts | {"NodeName": f"n{number}", "NodeID": str(number)} for number in (1, 2)]
    monkeypatch.setattr(module, "nodes", lambda: list(fake.nodes))
    monkeypatch.setattr(module, "_RECONCILE_SECONDS", 1e6)  # a test calls it
    monkeypatch.setattr(module, "die_with", lambda _: None)
    return fake


@pytest.fixture
def spec(tmp_path):
    (tmp_path / "store").mkdir()
    return FleetSpec("site", str(tmp_path / "store"), streams={"gate": GATE, "roof": ROOF})


@pytest.fixture
def made(ray, spec, monkeypatch, folder):  # noqa: ARG001  the module finds it as Ray
    """Starts a controller."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))  # no other fleet is found
    monkeypatch.setattr(module, "_PAUSE_SECONDS", 0.0)
    controllers = []

    def make():
        controllers.append(Controller("site", spec.store, "", ""))
        return controllers[-1]

    yield make
    for each in controllers:
        each.end()


@pytest.fixture
def site(made, spec):
    site = made()
    site.apply(spec, {})
    site._reconcile()
    return site


def running(site, ray, name, node="1", state="running", **facts):
    ray.of(name).status = StreamStatus(name, state, node, **facts)
    site._reconcile()  # asks, and takes the answer


def states(site):
    return {name: each.state for name, each in site.status().streams.items()}


def test_streams_are_detached_actors_placed_and_restarted_by_ray(site, ray):
    options = ray.of("roof").options
    assert options["num_cpus"] == 0.5
    assert (options["lifetime"], options["max_restarts"]) == ("detached", -1)
    assert states(site) == {"gate": "starting", "roof": "starting"}
    running(site, ray, "gate")
    assert (states(site)["gate"], site.status().streams["gate"].node) == ("running", "n1")
    assert site.status().nodes["n1"].used == 1.0


def test_restarted_controller_leaves_running_streams_alone(site, ray, made, spec):
    running(site, ray, "gate")
    actors = dict(ray.actors)
    ray.has_restarted = True
    again = made()
    again._reconcile()
    assert (ray.actors, ray.started) == (actors, ["gate", "roof"])
    assert again.apply(spec, {}) == ["gate: is unchanged", "roof: is unchanged"]
    assert states(again) == {"gate": "running", "roof": "starting"}


def test_restarted_controller_accepts_the_keys_of_its_clients(ray, spec, tmp_path, tcp):
    for has_restarted in (False, True):
        ray.has_restarted = has_restarted
        site = Controller("site", spec.store, tcp, str(tmp_path / "keys"))
        try:
            site.apply(spec, {})
            if not has_restarted:
                allow(tmp_path / "keys", "desk", "watch", output=tmp_path / "desk")
            with Registry(tcp.removeprefix("tcp://"), keys=str(tmp_path / "desk")) as registry:
                assert sorted(registry.streams().streams) == ["gate", "roof"]
        finally:
            site.end()


def test_ended_stream_is_started_again_only_if_it_is_changed(site, ray):
    began = time.monotonic()
    running(site, ray, "gate", state="ended", frame=31, stored_seconds=2.0)
    for _ in range(3):
        site._reconcile()
    assert (states(site)["gate"], ray.started.count("gate")) == ("ended", 1)
    assert 2.0 <= site.status().streams["gate"].stored_seconds <= 2.0 + time.monotonic() - began
    assert site.add(GATE, {}) == ["gate: has ended", "roof: is unchanged"]
    site.add(replace(GATE, source="demo:3"), {})
    for _ in range(2):
        site._reconcile()
    assert (states(site)["gate"], ray.started.count("gate")) == ("starting", 2)


def test_superseded_actor_is_killed_and_replaced(site, ray):
    actor = ray.of("gate")
    actor.superseded = True
    running(site, ray, "gate", state="failed")
    for _ in range(3):
        site._reconcile()
    assert ray.of("gate") is not actor


def test_removed_and_forgotten_stream_leaves_nothing(site, ray, spec):
    store = Store(spec.store)
    store.stream("gate").claim().write({"a": b""}, {"ended": False})
    with pytest.raises(FleetError, match=r"no stream named 'cam-8' in the fleet site \(streams: gate, roof\)"):
        site.remove(("cam-8",))
    assert site.remove(("gate",)) == ["gate: is removed", "roof: is unchanged"]
    store.stream("gate").clear()
    for _ in range(4):
        site._reconcile()
    assert store.stream("gate").newest() is None
    assert list(from_json(store.fleet.newest().files["fleet"]).streams) == ["roof"]
    assert "gate" not in site._actors
    site.add(GATE, {})
    site._reconcile()
    assert ray.of("gate").options["scheduling_strategy"] == "SPREAD"


def test_change_that_a_stream_cannot_continue_with_is_rejected(site, spec):
    assert "gate: starts again" in site.add(replace(GATE, settings={"run.lag_frames": 26}), {})[0]
    gate = replace(GATE, settings={"coreset.size": 32})
    changed = replace(spec, streams={"gate": gate, "roof": ROOF})
    for change, given in ((site.add, gate), (site.apply, changed)):
        with pytest.raises(FleetError, match=r"gate was started with coreset.size=64, not 32, .*remove gate --forget"):
            change(given, {})
    with pytest.raises(FleetError, match=r"the store of fleet .* cannot change .*: end the fleet first"):
        site.apply(replace(spec, store="s3://other"), {})
    site.remove(("gate",))
    site.apply(changed, {})


def test_change_that_cannot_be_stored_is_rejected(site, monkeypatch):
    def fails(*_):
        raise StoreError("the store cannot be reached")

    with monkeypatch.context() as patch:
        patch.setattr(StateStore, "put", fails)
        for change in (lambda: site.add(replace(GATE, name="new"), {}), lambda: site.remove(("gate",))):
            with pytest.raises(StoreError, match="cannot be reached"):
                change()
    assert sorted(site.status().streams) == ["gate", "roof"]


def test_registry_answers_while_the_store_hangs(site, ray, monkeypatch, until):
    hangs, goes_on = threading.Event(), threading.Event()

    def put(*_):
        hangs.set()
        goes_on.wait(500)

    monkeypatch.setattr(StateStore, "put", put)
    change = threading.Thread(target=site.remove, args=(("roof",),))
    change.start()
    try:
        assert hangs.wait(500)
        running(site, ray, "gate")
        with Registry("site", timeout=500) as registry:
            until(lambda: registry.streams().streams["gate"].state == "running")
            assert registry.stream("gate").node == "n1"
    finally:
        goes_on.set()
        change.join()
    assert sorted(site.status().streams) == ["gate"]


def test_restarted_controller_waits_for_its_store(made, ray, spec, monkeypatch):
    before = made()
    before.apply(spec, {})
    before.end()
    ray.has_restarted = True
    with monkeypatch.context() as patch:
        patch.setattr(StateStore, "newest", lambda _: (_ for _ in ()).throw(StoreError("the store cannot be reached")))
        again = made()
        for call in (again.ready, lambda: again.apply(spec, {})):
            with pytest.raises(StoreError, match="cannot be reached"):
                call()
    with Registry("site", timeout=0.5) as registry, pytest.raises(SilenceError):
        registry.streams()  # an empty answer would end each subscription
    again._begin()
    again.ready()
    assert sorted(again.status().streams) == ["gate", "roof"]


def test_pending_or_silent_stream_is_reported_before_its_restart(made, spec, ray, monkeypatch):
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    site = made()
    site.apply(spec, {})
    site._reconcile()
    running(site, ray, "gate")
    assert [each.trouble for each in site.status().streams.values()] == ["", ""]
    ray.of("gate").status = None  # its machine is cut off
    site._reconcile()
    now += 50
    site._reconcile()
    gate, roof = site.status().streams.values()
    assert (gate.state, gate.node, gate.trouble) == ("running", "n1", "it has not answered for 50 s")
    unplaced = "Ray has not started it for 50 s: see its demands in `ray status`"
    assert (roof.state, roof.trouble) == ("starting", unplaced)


def test_hanging_actor_is_restarted_and_killed_if_it_does_not_stop(site, ray, monkeypatch):
    running(site, ray, "gate")
    gate, roof = ray.of("gate"), ray.of("roof")
    gate.status = None
    site._reconcile()
    later = time.monotonic() + module.SILENT_SECONDS + 1
    monkeypatch.setattr(time, "monotonic", lambda: later)
    site._reconcile()
    assert (gate.restarted, roof.restarted) == (1, 0), "Ray waits for a node for the roof"
    site._actors["gate"].call = Call(error=RayError("killed"))
    site._reconcile()
    running(site, ray, "gate")
    gate.unstored = None  # it does not answer
    site.remove(("gate",))
    site._reconcile()
    assert gate.asked[-1] == ("stop",)
    later += module.STOPPING_SECONDS + 1
    for _ in range(3):
        site._reconcile()
    assert "gate" not in site._actors


def test_streams_are_stopped_before_the_fleet_ends(site, ray):
    running(site, ray, "gate")
    running(site, ray, "roof")
    gate = ray.of("gate")
    gate.unstored = "the store is full"
    assert site.close() == ["gate", "roof"]
    site._reconcile()
    assert states(site) == {"gate": "stopping", "roof": "stopping"}
    assert gate.asked[-1] == ("stop",)
    for _ in range(3):
        site._reconcile()
    assert (site.close(), ray.actors) == ([], {})
    assert states(site) == {"gate": "stopping", "roof": "stopping"}
    assert site.end() == ["gate: the store is full"]


def test_controller_of_an_ended_fleet_runs_nothing_before_up(site, ray, made, spec):
    for _ in range(4):
        site.close()
        site._reconcile()
    again = made()
    again._reconcile()
    assert ray.actors == {}
    lines = again.apply(replace(spec, streams={"gate": GATE, "lake": StreamSpec("lake", "demo:3")}), {})
    assert lines == ["gate: continues from its last state", "lake: is added", "roof: is removed"]
    again._reconcile()
    assert sorted(ray.started[-2:]) == ["gate", "lake"]

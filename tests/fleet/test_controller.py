"""The controller of a fleet, with a Ray of this file's own: what it starts, stops, stores and answers."""

from __future__ import annotations

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
from catstream.fleet import life
from catstream.fleet.controller import Controller
from catstream.fleet.desired import Desired
from catstream.fleet.life import Node
from catstream.fleet.spec import FleetSpec, StreamSpec, from_json
from catstream.fleet.store import States, Store
from catstream.fleet.stream import Report, _free_port
from catstream.messages.kinds import StreamStatus
from catstream.wire.keys import allow

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


class Actor:
    """The actor of a stream, which the test lets run."""

    def __init__(self, cluster, options, spec, order):
        self.cluster, self.options, self.spec, self.order = cluster, options, spec, order
        self.status, self.superseded, self.asked, self.restarted = None, False, [], 0
        self.unstored = ""  # why its last state cannot be stored
        for name in ("report", "stop", "logs"):
            setattr(self, name, types.SimpleNamespace(remote=lambda *given, name=name: self._called(name, given)))

    def runs(self, node, state="running", **facts):
        """Let it run on a node."""
        self.status = StreamStatus(self.spec.name, state, node, **facts)

    def _called(self, name, given):
        self.asked.append((name, *given))
        if name == "stop":
            return Call(self.unstored)
        if name == "logs":
            return Call(["a line"])
        return Call(Report(self.status, self.order, self.superseded) if self.status else None)


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
        self.strategies = types.ModuleType("ray.util.scheduling_strategies")
        self.strategies.NodeAffinitySchedulingStrategy = lambda node, *, soft: (node, soft)

    def get_runtime_context(self):
        return types.SimpleNamespace(was_current_actor_reconstructed=self.has_restarted)

    def remote(self, _):
        return types.SimpleNamespace(
            options=lambda **options: types.SimpleNamespace(remote=lambda *given: self._start(options, *given))
        )

    def _start(self, options, spec, order, *_):
        if options["name"] in self.actors:
            raise ValueError("the name is taken")
        actor = self.actors[options["name"]] = Actor(self, options, spec, order)
        self.started.append(spec.name)
        return actor

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
    for part in (fake, fake.util, fake.exceptions, fake.strategies):
        monkeypatch.setitem(sys.modules, part.__name__, part)
    fake.nodes = [Node("n1", "1", "127.0.0.1", 2.0), Node("n2", "2", "127.0.0.1", 2.0)]
    monkeypatch.setattr(module, "nodes", lambda: list(fake.nodes))
    monkeypatch.setattr(module, "is_local", lambda: True)
    monkeypatch.setattr(Controller, "_run", lambda _: None)  # a test calls each turn
    return fake


@pytest.fixture
def spec(tmp_path):
    (tmp_path / "store").mkdir()
    return FleetSpec("site", str(tmp_path / "store"), streams={"gate": GATE, "roof": ROOF})


@pytest.fixture
def made(ray, spec, monkeypatch, folder):  # noqa: ARG001  the module finds it as Ray
    """Starts a controller."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))  # no other fleet is found
    monkeypatch.setattr(life, "PAUSE_SECONDS", 0.0)
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
    site.change("applied", spec, "vm:/a/fleet.toml", replace_other=False)
    site._turn()
    return site


def running(site, ray, name, node="1", **facts):
    ray.actors[f"site/stream/{name}"].runs(node, **facts)
    site._turn()  # asks, and takes the answer


def states(site):
    return {name: each.state for name, each in site.status().streams.items()}


def test_streams_are_detached_actors_that_ray_places_and_restarts(site, ray):
    options = ray.actors["site/stream/roof"].options
    assert options["num_cpus"] == 0.5
    assert (options["lifetime"], options["max_restarts"]) == ("detached", -1)
    assert states(site) == {"gate": "starting", "roof": "starting"}
    running(site, ray, "gate")
    assert (states(site)["gate"], site.status().streams["gate"].node) == ("running", "n1")
    assert site.status().nodes["n1"].used == 1.0
    assert options["scheduling_strategy"] == "SPREAD"


def test_a_controller_that_starts_again_touches_no_stream_that_runs(site, ray, made, spec):
    running(site, ray, "gate")
    running(site, ray, "roof")
    actors = dict(ray.actors)
    ray.has_restarted = True
    again = made()
    again._turn()
    assert (ray.actors, ray.started) == (actors, ["gate", "roof"])
    assert again.change("applied", spec, "", replace_other=False) == ["gate: is unchanged", "roof: is unchanged"]
    assert states(again) == {"gate": "running", "roof": "running"}


def test_a_controller_that_starts_again_keeps_the_keys_of_the_clients(ray, spec, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "is_local", lambda: False)
    free_port = _free_port("127.0.0.1")
    for has_restarted in (False, True):
        ray.has_restarted = has_restarted
        site = Controller("site", spec.store, f"tcp://127.0.0.1:{free_port}", str(tmp_path / "keys"))
        try:
            site.ready()
            site.change("applied", spec, "", replace_other=False)
            if not has_restarted:
                allow(tmp_path / "keys", "desk", "watch", output=tmp_path / "desk")
            with Registry(f"127.0.0.1:{free_port}", keys=str(tmp_path / "desk")) as registry:
                assert sorted(registry.streams().streams) == ["gate", "roof"]
        finally:
            site.end()


@pytest.mark.parametrize(("parent", "shared"), [(4711, [4711]), (1, [])], ids=["alive", "dead"])
def test_no_start_server_outlives_its_node(parent, shared, monkeypatch):
    found = []
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(module.os, "getppid", lambda: parent)
    monkeypatch.setattr(module, "share_start_server", found.append)
    monkeypatch.setattr(module, "start_server", lambda: None)
    module.warm()
    assert found == shared


def test_a_stream_that_is_moved_stops_first_and_starts_on_the_node(site, ray):
    running(site, ray, "gate")
    site.change("moved", "gate", ray.nodes[1])
    assert states(site)["gate"] == "moving", "from the answer on, so that `up` waits for it"
    site._turn()
    assert states(site)["gate"] == "moving"
    assert ray.actors["site/stream/gate"].asked[-1] == ("stop", "moved")
    for _ in range(3):
        site._turn()
    assert ray.actors["site/stream/gate"].options["scheduling_strategy"] == ("2", True)
    running(site, ray, "gate", "2")
    site.change("moved", "gate", ray.nodes[1])
    site._turn()
    assert states(site)["gate"] == "running", "it is there already"


def test_a_drained_node_loses_its_streams_and_gets_them_back_only_if_it_takes_streams_again(site, ray):
    running(site, ray, "gate")
    site.change("drained", ray.nodes[0], undo=False)
    for _ in range(4):
        site._turn()
    assert ray.actors["site/stream/gate"].options["label_selector"] == {"ray.io/node-id": "!in(1)"}
    assert site.status().nodes["n1"].state == "draining"
    running(site, ray, "gate", "2")
    site.change("drained", ray.nodes[0], undo=True)
    site._turn()
    assert states(site)["gate"] == "running", "it stays where it is"


def test_a_stream_that_was_moved_to_a_drained_node_does_not_return_to_it(site, ray):
    running(site, ray, "gate")
    site.change("moved", "gate", ray.nodes[0])
    site.change("drained", ray.nodes[0], undo=False)
    for _ in range(4):
        site._turn()
    running(site, ray, "gate", "2")
    site.change("drained", ray.nodes[0], undo=True)
    site._turn()
    assert states(site)["gate"] == "running"


def test_a_node_that_was_drained_a_moment_ago_has_no_room(site, spec, ray):
    for node in ray.nodes:
        site.change("drained", node, undo=False, may_wait=True)
    with pytest.raises(FleetError, match=r"roof needs a node that is not drained.* n2 \(drained\)"):
        site.change("applied", spec, "", replace_other=False)
    site.change("drained", ray.nodes[0], undo=True)
    site.change("applied", spec, "", replace_other=False)


def test_a_stream_that_was_moved_to_a_node_that_died_is_placed_by_ray_and_stays_there(site, ray):
    site.change("moved", "gate", ray.nodes[1])
    for _ in range(3):
        site._turn()
    running(site, ray, "gate", "2")
    ray.nodes[1] = replace(ray.nodes[1], alive=False)
    actor = ray.actors["site/stream/gate"]
    site._streams["gate"].call = Call(error=RayError("unavailable"))
    site._turn()
    assert states(site)["gate"] == "starting"
    ray.nodes[1] = replace(ray.nodes[1], id="3", alive=True)
    running(site, ray, "gate", "1")
    assert ray.actors["site/stream/gate"] is actor
    assert site.status().streams["gate"].node == "n1"


def test_a_stream_that_has_ended_is_stopped_and_runs_again_only_if_it_is_changed(site, ray):
    running(site, ray, "gate", state="ended", frame=31)
    for _ in range(3):
        site._turn()
    assert (states(site)["gate"], ray.started.count("gate")) == ("ended", 1)
    assert site.change("added", GATE) == ["gate: has ended", "roof: is unchanged"]
    site.change("added", StreamSpec("lake", "demo:2", cores=2.0))  # in the place of the one that has ended
    site.change("added", replace(GATE, source="demo:3"))
    for _ in range(2):
        site._turn()
    assert (states(site)["gate"], ray.started.count("gate")) == ("starting", 2)


def test_the_last_state_of_a_stream_that_has_ended_ages_from_its_last_report_on(site, ray):
    begin = time.monotonic()
    running(site, ray, "gate", state="ended", stored_seconds=2.0)
    for _ in range(3):
        site._turn()
    age = site.status().streams["gate"].stored_seconds
    assert 2.0 <= age <= 2.0 + time.monotonic() - begin


def test_one_that_another_process_has_claimed_is_killed_and_claims_again(site, ray):
    actor = ray.actors["site/stream/gate"]
    actor.superseded = True
    running(site, ray, "gate", state="failed")
    for _ in range(3):
        site._turn()
    assert ray.actors["site/stream/gate"] is not actor


def test_of_a_stream_that_is_removed_and_forgotten_nothing_is_left(site, ray, spec):
    store = Store(spec.store)
    store.stream("gate").claim("n1").write({"a": b""}, {"ended": False})
    site.change("moved", "gate", ray.nodes[1])
    assert site.change("removed", ["gate"]) == ["gate: is removed", "roof: is unchanged"]
    store.stream("gate").clear()
    for _ in range(4):
        site._turn()
    assert store.stream("gate").newest() is None
    assert from_json(store.fleet.newest().files["fleet"], Desired).pins == {}
    assert "gate" not in site._streams
    site.change("added", GATE)
    site._turn()
    assert ray.actors["site/stream/gate"].options["scheduling_strategy"] == "SPREAD"


def test_a_setting_with_which_a_stream_cannot_continue_is_not_changed(site, spec):
    assert "gate: starts again" in site.change("added", replace(GATE, settings={"run.lag_frames": 26}))[0]
    gate = replace(GATE, settings={"coreset.size": 32})
    changed = replace(spec, streams={"gate": gate, "roof": ROOF})
    for change in (("added", gate), ("applied", changed, "")):
        more = {"replace_other": False} if change[0] == "applied" else {}
        with pytest.raises(FleetError, match=r"gate was started with coreset.size=64, not 32: .*remove gate --forget"):
            site.change(*change, **more)
    site.change("removed", ["gate"])
    site.change("applied", changed, "", replace_other=False)


def test_a_change_that_cannot_be_stored_is_refused_and_not_done(site, ray, monkeypatch):
    def fails(*_):
        raise StoreError("the store cannot be reached")

    with monkeypatch.context() as patch:
        patch.setattr(States, "put", fails)
        for change in (
            lambda: site.change("added", replace(GATE, name="new")),
            lambda: site.change("moved", "gate", ray.nodes[1]),
            lambda: site.change("drained", ray.nodes[0], undo=False),
            lambda: site.change("removed", ["gate"]),
        ):
            with pytest.raises(StoreError, match="cannot be reached"):
                change()
    assert sorted(site.status().streams) == ["gate", "roof"]
    assert site.status().nodes["n1"].state == "alive"


def test_while_the_store_hangs_the_registry_answers_and_streams_are_watched(site, ray, monkeypatch, until):
    hangs, goes_on = threading.Event(), threading.Event()

    def put(*_):
        hangs.set()
        goes_on.wait(60)

    monkeypatch.setattr(States, "put", put)
    change = threading.Thread(target=site.change, args=("drained", ray.nodes[0]), kwargs={"undo": False})
    change.start()
    try:
        assert hangs.wait(60)
        running(site, ray, "gate")
        with Registry("site", timeout=30) as registry:
            until(lambda: registry.streams().streams["gate"].state == "running")
            assert registry.stream("gate").node == "n1"
    finally:
        goes_on.set()
        change.join()
    site._turn()
    assert site.status().nodes["n1"].state == "draining"


def test_a_controller_that_is_restarted_while_the_store_is_away_begins_once_it_is_back(made, ray, spec, monkeypatch):
    before = made()
    before.change("applied", spec, "", replace_other=False)
    before.end()
    ray.has_restarted = True
    with monkeypatch.context() as patch:
        patch.setattr(States, "newest", lambda _: (_ for _ in ()).throw(StoreError("the store cannot be reached")))
        again = made()
        with pytest.raises(StoreError, match="cannot be reached"):
            again.ready()
        with pytest.raises(StoreError, match="cannot be reached"):
            again.change("applied", spec, "", replace_other=False)
    with Registry("site", timeout=0.5) as registry, pytest.raises(SilenceError):
        registry.streams()  # an empty answer would be the end of each stream for those who follow it
    again._begin()
    again.ready()
    assert sorted(again.status().streams) == ["gate", "roof"]


def test_streams_of_another_file_are_replaced_only_if_that_is_said(site, spec):
    other = replace(spec, streams={"lake": StreamSpec("lake", "demo:3")})
    with pytest.raises(FleetError, match=r"runs the streams of vm:/a/fleet.toml, not of vm:/b/fleet.toml.*--replace"):
        site.change("applied", other, "vm:/b/fleet.toml", replace_other=False)
    assert sorted(site.status().streams) == ["gate", "roof"]
    site.change("applied", other, "vm:/b/fleet.toml", replace_other=True)
    assert sorted(site.status().streams) == ["lake"]


def test_too_many_streams_are_refused_before_they_start_unless_they_may_wait(site, spec):
    many = replace(spec, streams={f"cam-{n}": StreamSpec(f"cam-{n}", "demo:1") for n in range(20)})
    with pytest.raises(FleetError, match="the 20 streams need 20 cores, and the nodes have 4"):
        site.change("applied", many, "", replace_other=False)
    with pytest.raises(FleetError, match="lake needs 4 cores, and the largest node that it may run on, n1, has 2"):
        site.change("added", StreamSpec("lake", "demo:3", cores=4.0))
    assert sorted(site.status().streams) == ["gate", "roof"]
    site.change("applied", many, "", replace_other=False, may_wait=True)
    assert len(site.status().streams) == 20


def test_what_a_stream_waits_for_is_said(site, ray):
    ray.nodes[:] = [Node("n1", "1", "127.0.0.1", 1.0)]
    running(site, ray, "roof")
    site._turn()
    waiting = site.status().streams["gate"]
    assert waiting.state == "unplaced"
    assert waiting.trouble == "it waits for 1 free cores: no node that it may run on has more than 0.5"


def test_a_stream_that_does_not_answer_is_said_long_before_it_is_started_again(site, ray, monkeypatch):
    running(site, ray, "gate")
    assert site.status().streams["gate"].trouble == ""
    ray.actors["site/stream/gate"].status = None  # its machine is cut off
    site._turn()
    later = time.monotonic() + 50
    monkeypatch.setattr(time, "monotonic", lambda: later)
    site._turn()
    gate = site.status().streams["gate"]
    assert (gate.state, gate.node) == ("running", "n1")
    assert gate.trouble in ("it has not answered for 50 s", "it has not answered for 51 s")


def test_followed_objects_and_clients_reach_a_stream_with_each_question(site, ray):
    site.change("added", replace(GATE, follow=("anna",)))
    running(site, ray, "gate")
    assert ray.actors["site/stream/gate"].asked[-1] == ("report", None, ("anna",))


def test_all_streams_are_stopped_before_a_fleet_ends(site, ray):
    running(site, ray, "gate")
    running(site, ray, "roof")
    gate = ray.actors["site/stream/gate"]
    gate.unstored = "the store is full"
    assert site.close() == 2
    site._turn()
    assert states(site) == {"gate": "stopping", "roof": "stopping"}
    assert gate.asked[-1] == ("stop", "stopped")
    for _ in range(3):
        site._turn()
    assert (site.close(), ray.actors) == (0, {})
    assert states(site) == {"gate": "stopping", "roof": "stopping"}
    assert site.end() == ["gate: the store is full"]


def test_a_controller_that_is_started_after_the_end_of_a_fleet_runs_nothing_before_the_first_up(site, ray, made, spec):
    for _ in range(4):
        site.close()
        site._turn()
    again = made()
    again._turn()
    assert ray.actors == {}
    streams = {"gate": GATE, "lake": StreamSpec("lake", "demo:3")}
    lines = again.change("applied", replace(spec, streams=streams), "", replace_other=False)
    assert lines == ["gate: continues from its last state", "lake: is added", "roof: is removed"]
    again._turn()
    assert sorted(ray.actors) == ["site/stream/gate", "site/stream/lake"]

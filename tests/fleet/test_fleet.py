"""A fleet on a real cluster: streams that are started, moved, continued after a death, refused and removed."""

from __future__ import annotations

import os
from dataclasses import replace
from importlib import import_module

import pytest

import catstream
from catstream.errors import FleetError
from catstream.fleet.fleet import Fleet
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.fleet.store import Store
from catstream.loadtest.nodes import kill_node
from catstream.video.live_demo import first_box

pytestmark = pytest.mark.system

FRAMES = 32
LIVE = "demo:1?rate=10"


@pytest.fixture(scope="module")
def streams(demo_video):
    path, truth = demo_video(FRAMES)
    film = StreamSpec("film", str(path), {"": truth[0]}, settings={"run.lockstep": True}, cores=0.3)
    return {"film": film, "gate": StreamSpec("gate", LIVE, {"anna": first_box(LIVE)}, cores=0.3)}


@pytest.fixture(scope="module")
def site(fleet, runtime, streams, tmp_path_factory):
    """A fleet with two streams on the shared cluster, and its spec."""
    home = tmp_path_factory.mktemp("home")
    (home / "catstream" / "fleets").mkdir(parents=True)
    (home / "catstream" / "fleets" / "site").symlink_to(fleet.folder)
    spec = FleetSpec("site", str(home / "store"), every=0.5, nodes=2, streams=streams)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(home))
        patch.setenv("XDG_RUNTIME_DIR", str(runtime))
        site = Fleet(spec)
        site.up(cores=1)
        yield site, spec
        site.remove(*site.status().streams)
        while any(node.streams for node in site.status().nodes.values()):
            pass
        site.end_manager()


def test_a_film_runs_to_its_end_and_is_not_run_again(site, until):
    fleet, spec = site
    until(lambda: fleet.status().streams["film"].state == "ended")
    assert Store(spec.store).newest("film").facts["seq"] == FRAMES
    assert "film: is unchanged" in fleet.up(cores=1)
    assert fleet.status().streams["film"].state == "ended"


def test_a_subscriber_stays_attached_to_a_stream_that_moves(site, until):
    fleet, _ = site
    until(lambda: fleet.status().streams["gate"].state == "running")
    before = fleet.status().streams["gate"]
    other = "node-2" if before.node == "node-1" else "node-1"
    with catstream.subscribe("fleet://site/gate", "tracks", timeout=60) as tracks:
        first = next(tracks)
        fleet.move("gate", other)
        until(lambda: fleet.status().streams["gate"].token > before.token)
        until(lambda: fleet.status().streams["gate"].node == other)
        later = next(track for track in tracks if track.time > first.time + 1)
    assert (later.object, later.seq > first.seq) == ("anna", True)
    assert "is added" not in " ".join(fleet.logs("gate"))


def test_a_stream_of_a_dead_node_continues_elsewhere(site, fleet, until):
    site, spec = site
    fleet.start_node("node-9", 1.0)
    until(lambda: site.status().nodes.get("node-9"))
    site.move("gate", "node-9")
    until(lambda: (found := site.status().streams["gate"]).node == "node-9" and found.state == "running")
    until(lambda: Store(spec.store).newest("gate").facts["seq"] > 5)
    before = site.status().streams["gate"]
    kill_node(fleet, "node-9")
    until(lambda: (found := site.status().streams["gate"]).token > before.token and found.state == "running")
    after = site.status().streams["gate"]
    assert after.node in ("node-1", "node-2")
    assert after.frame > before.frame  # numbers go on after what was lost
    assert after.lost_frames > 0


@pytest.mark.usefixtures("fleet")
def test_processes_of_the_nodes_have_the_priority_of_the_process_that_starts_them():
    ray = import_module("ray")
    theirs = ray.get(ray.remote(num_cpus=0)(lambda: os.getpriority(os.PRIO_PROCESS, 0)).remote())
    assert theirs == os.getpriority(os.PRIO_PROCESS, 0)


def test_what_fits_nowhere_is_refused_and_nothing_is_changed(site):
    fleet, spec = site
    with pytest.raises(FleetError, match="gate needs 4 cores, and the largest node"):
        fleet.add(replace(spec.streams["gate"], cores=4.0))
    with pytest.raises(FleetError, match=r"cam-8 needs 4 cores, and the largest node"):
        fleet.add(StreamSpec("cam-8", LIVE, cores=4))
    with pytest.raises(FleetError, match="cam-9 needs a node with site=north"):
        fleet.add(StreamSpec("cam-9", LIVE, labels={"site": "north"}))
    with pytest.raises(FleetError, match="no stream 'cam-8'"):
        fleet.move("cam-8", "node-1")
    assert set(fleet.status().streams) == {"film", "gate"}


def test_a_stream_whose_source_cannot_be_opened_has_failed_until_it_is_changed(site, until):
    fleet, _ = site
    fleet.add(StreamSpec("cam-8", "missing.mp4", cores=0.1))
    until(lambda: (found := fleet.status().streams["cam-8"]).state == "failed" and "missing.mp4" in found.trouble)
    fleet.add(StreamSpec("cam-8", LIVE, cores=0.1))
    assert fleet.status().streams["cam-8"].state in ("moving", "starting")
    fleet.remove("cam-8", forget=True)


def test_a_node_that_is_drained_gives_its_streams_away(site, until):
    fleet, _ = site
    node = fleet.status().streams["gate"].node
    fleet.drain(node)
    until(lambda: (found := fleet.status().streams["gate"]).node not in ("", node) and found.state == "running")
    fleet.drain(node, undo=True)


def test_a_fleet_that_does_not_run_cannot_be_ended(tmp_path):
    with pytest.raises(FleetError, match="no fleet 'other' of yours runs"):
        Fleet(name="other", folder=tmp_path / "other").down()

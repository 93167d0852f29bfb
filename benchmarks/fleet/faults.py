"""Injects a random schedule of faults into a fleet on three nodes, and checks that no stream and no row is lost.

The nodes are those of Ray's own test utility, on this machine. They are killed or frozen with all of their processes,
also two at once, and start again after ten seconds; the process of a stream and the controller are killed; nobody can
reach the store, which is a real S3 server. Some of six streams are live, others are short films in lockstep: whenever a
film ends, its trees must be equal, bit for bit, to those of a run in one process without faults, and it begins anew.
Recovery is the time until the next track of a stream, from the fault, and from the moment at which Ray has noticed it,
both as the registry shows it: the controller looks twice a second. The films take all cores of a small machine; without
them, `--films 0 --rate 2` leaves one of two cores free.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from time import monotonic, sleep

import httpx
import numpy as np
import psutil

sys.path.append(str(Path(__file__).parents[1]))  # shared modules of the benchmarks

from chaos import fingerprint, quantiles, undisturbed
from table import Table, benchmark, command

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.client.registry import REGISTRY_PORT, Registry
from catstream.coreset.forest import Forest
from catstream.errors import CatstreamError, ServiceError
from catstream.fleet.fleet import Fleet
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.fleet.store import Store
from catstream.processes.state import restore
from catstream.video import rendered
from catstream.video.live_demo import first_box
from catstream.wire.keys import allow
from catstream.wire.messages import FleetStatus, StreamStatus

NAME = "faults"
NODES = ("node-2", "node-3")  # node-1 is the head
RETURN = 10.0  # seconds from the death of a node to its next start: its streams, which start elsewhere, come first
#: Of Ray: a dead node is noticed after two seconds, one that hangs after six.
VARIABLES = {
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # it listens on the loopback interface only
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
    "RAY_health_check_initial_delay_ms": "1000",
    "RAY_health_check_period_ms": "500",
    "RAY_health_check_timeout_ms": "1500",
    "RAY_health_check_failure_threshold": "3",
}
CORES = 2  # of a node, as Ray counts them: one node bears all streams
NEED = 0.3
EVERY = 3.0  # seconds between two states
FILM = 400  # frames
FROZEN = (4.0, 8.0)  # seconds
UNREACHABLE = 60.0
CALM = (1.5, 4.0)  # seconds between a recovery and the next fault
PATIENCE = 180.0
STREAMS = 6


class Trial:
    """A fleet under faults.

    live      sources of the live streams, by name
    rate      frames per second of the live streams
    lockstep  names of the films, which are tracked in lockstep
    recovery  seconds from a fault until the streams that it hit went on, by the name of the fault
    noticed   the same from the moment at which Ray has noticed that a node or a process died
    wrong     descriptions of what must not happen
    """

    def __init__(self, stack: ExitStack, seed: int, live: int, films: int, rate: float) -> None:
        self.live = {f"live-{number}": f"demo:{number}" for number in range(1, live + 1)}
        self.rate = rate
        self.lockstep = tuple(f"film-{number}" for number in range(1, films + 1))
        self.random = np.random.default_rng(seed)
        self.recovery: dict[str, list[float]] = defaultdict(list)
        self.noticed: dict[str, list[float]] = defaultdict(list)
        self.wrong: list[str] = []
        self.films = 0  # that have ended with the right trees
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cs-")))
        os.environ |= VARIABLES | {"XDG_STATE_HOME": str(folder)}
        self.server = self._open_store(stack)
        rendered.write(folder, FILM, (320, 240))
        self.film = folder / "demo.mp4"
        self.box = Box(*np.loadtxt(folder / "groundtruth_rect.txt", delimiter=",", max_rows=1).tolist())
        self.calm = fingerprint(undisturbed(str(self.film), {"": self.box})[1])
        from ray.cluster_utils import Cluster

        self.cluster = Cluster(initialize_head=True, head_node_args=_node("node-1") | {"include_dashboard": False})
        stack.callback(self.cluster.shutdown)
        self.nodes = {name: self.cluster.add_node(**_node(name)) for name in NODES}
        self.dead: dict[str, float] = {}  # the moment at which a node died
        streams = {each.name: each for each in self._streams()}
        registry = f"127.0.0.1:{REGISTRY_PORT}"
        spec = FleetSpec(NAME, "s3://states/faults", EVERY, registry=registry, streams=streams)
        self.fleet = stack.enter_context(Fleet(spec, address=self.cluster.address))
        self.fleet.up()
        stack.callback(self.fleet.down)
        allow(folder / "catstream" / "fleets" / NAME / "keys", "trial", "watch", output=folder / "trial")
        self.registry = stack.enter_context(Registry(registry, str(folder / "trial"), timeout=2.0))
        self.store = Store(spec.store)

    def processes(self, node: str) -> list[psutil.Process]:
        """The processes of a node, its raylet first; none if it has died."""
        raylets = self.raylets(node)
        pids = {str(raylet.pid) for raylet in raylets}
        return [*raylets, *(each for each in psutil.process_iter() if _raylet_of(each) in pids)]

    def raylets(self, node: str) -> list[psutil.Process]:
        """The process of Ray that is a node; none while it is dead."""
        return [each for each in psutil.Process().children() if _is_raylet(each, node)]

    def revive(self) -> None:
        """Start the nodes again that died ten seconds ago."""
        for name, node in list(self.nodes.items()):
            if name not in self.dead and not self.raylets(name):
                self.dead[name] = monotonic()
                self.cluster.remove_node(node, allow_graceful=False)
            elif name in self.dead and monotonic() - self.dead[name] > RETURN:
                with suppress(Exception):  # Ray has no type for a node that does not start in time
                    self.nodes[name] = self.cluster.add_node(**_node(name))
                    del self.dead[name]

    def send(self, number: signal.Signals, *nodes: str) -> None:
        """Send a signal to all processes of nodes."""
        for process in [process for node in nodes for process in self.processes(node)]:
            with suppress(psutil.Error):
                process.send_signal(number)

    def _open_store(self, stack: ExitStack) -> subprocess.Popen[bytes]:
        """Start an S3 server."""
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        command = [sys.executable, "-m", "moto.server", "-p", str(port)]
        server = stack.enter_context(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        stack.callback(server.kill)
        os.environ |= {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}
        os.environ["AWS_ENDPOINT_URL"] = f"http://127.0.0.1:{port}"
        deadline = monotonic() + PATIENCE
        while monotonic() < deadline:
            with suppress(httpx.ConnectError):  # it is starting
                httpx.put(f"http://127.0.0.1:{port}/states")  # creates the bucket
                return server
        raise ServiceError(f"the S3 server did not start in {PATIENCE:g} s")

    def _streams(self) -> Iterator[StreamSpec]:
        for name, source in self.live.items():
            yield StreamSpec(name, source, {"": first_box(source)}, settings={"run.image_rate": self.rate}, cores=NEED)
        for name in self.lockstep:
            yield StreamSpec(name, str(self.film), {"": self.box}, settings={"run.lockstep": True}, cores=NEED)

    def status(self) -> FleetStatus | None:
        """The state of the fleet; None while the registry does not answer."""
        with suppress(CatstreamError):
            return self.registry.streams()
        return None

    def until(self, done: Callable[[FleetStatus], bool], what: str) -> bool:
        """Wait until something holds; False, and a note, if it does not in time."""
        deadline = monotonic() + PATIENCE
        while monotonic() < deadline:
            status = self.status()
            if status is not None and done(status):
                return True
            self.revive()
            sleep(0.05)
        self.wrong.append(f"{what} did not happen in {PATIENCE:g} s")
        return False

    def settle(self) -> None:
        """Wait until all nodes live and all streams run; films that have ended are checked and begin anew."""
        self.until(
            lambda status: all(each.state == "alive" and self.raylets(name) for name, each in status.nodes.items()),
            "all nodes alive",  # Ray may not have noticed yet that one has died
        )
        self.until_all_run()
        status = self.status()
        for name in self.lockstep:
            if status is not None and status.streams[name].state == "ended":
                self._check_film(name)
                self.fleet.remove(name, forget=True)
                self.until(lambda status, name=name: name not in status.streams, f"the end of {name}")
                self.fleet.add(next(each for each in self._streams() if each.name == name))
        self.until_all_run()

    def until_all_run(self) -> None:
        """Wait until all streams run, or have ended."""
        self.until(lambda status: all(_is_up(each) for each in status.streams.values()), "all streams running")

    def _check_film(self, name: str) -> None:
        state = self.store.stream(name).newest()
        if state is None:
            self.wrong.append(f"{name} has ended without a state")
            return
        with tempfile.TemporaryDirectory() as folder:
            restore(Path(folder), state.files)
            (file,) = Path(folder).glob("trees/*.safetensors")
            forest = Forest.load(file, Settings(run={"lockstep": True}).for_length(FILM))
        if forest.seq != FILM or fingerprint(forest) != self.calm:
            self.wrong.append(f"{name} has {forest.seq} of {FILM} messages, or other trees")
        else:
            self.films += 1

    def recovered(self, fault: str, hit: dict[str, StreamStatus], since: float, *, is_process: bool = False) -> None:
        """Wait until each stream that was hit tracks again, and keep the times."""
        waiting, noticed = dict(hit), dict[str, float]()

        def step(status: FleetStatus) -> bool:
            for name, before in list(waiting.items()):
                now = status.streams[name]
                has_died = before.node not in status.nodes or status.nodes[before.node].state == "dead"
                if now.token > before.token or has_died or (is_process and now.state != "running"):
                    noticed.setdefault(name, monotonic())
                if now.token > before.token and now.state == "running":  # it has tracked a frame
                    from_fault, from_notice = monotonic() - since, monotonic() - noticed[name]
                    self.recovery[fault].append(from_fault)
                    self.noticed[fault].append(from_notice)
                    print(f"  {name} after {from_fault:.1f} s, {from_notice:.1f} s from Ray's notice", file=sys.stderr)
                    del waiting[name]
                elif now.state == "ended":
                    del waiting[name]
            return not waiting

        self.until(step, f"{fault}: the recovery of {', '.join(waiting)}")


def _node(name: str) -> dict[str, object]:
    return {"node_name": name, "num_cpus": CORES, "object_store_memory": 80 << 20}


def _is_raylet(process: psutil.Process, node: str) -> bool:
    with suppress(psutil.Error):  # it has ended
        return f"--node-name={node}" in process.cmdline()
    return False


def _raylet_of(process: psutil.Process) -> str:
    """The raylet that has started a process, or its start server; empty for another process."""
    with suppress(psutil.Error):
        return process.environ().get("RAY_RAYLET_PID", "")
    return ""


def _is_up(stream: StreamStatus) -> bool:
    return stream.state == "ended" or (stream.state == "running" and stream.frame >= 0)


def _on(status: FleetStatus, *nodes: str) -> dict[str, StreamStatus]:
    return {name: each for name, each in status.streams.items() if each.node in nodes and each.state == "running"}


def kill(trial: Trial, status: FleetStatus) -> None:
    node = str(trial.random.choice([node for node in NODES if _on(status, node)] or NODES))
    begin = monotonic()
    trial.send(signal.SIGKILL, node)
    trial.recovered("node killed", _on(status, node), begin)


def kill_two(trial: Trial, status: FleetStatus) -> None:
    begin = monotonic()
    trial.send(signal.SIGKILL, *NODES)
    trial.recovered("two nodes killed", _on(status, *NODES), begin)


def freeze(trial: Trial, status: FleetStatus) -> None:
    node = str(trial.random.choice(NODES))
    begin = monotonic()
    trial.send(signal.SIGSTOP, node)
    sleep(float(trial.random.uniform(*FROZEN)))
    trial.send(signal.SIGCONT, node)
    sleep(1.0)
    now = trial.status()
    hit = {name: each for name, each in _on(status, node).items() if now is None or now.streams[name] != each}
    if now is None or now.nodes[node].state != "alive":  # Ray counts it as dead: its streams run elsewhere
        trial.recovered("node frozen", hit, begin)
        trial.until(lambda status: status.nodes[node].state == "alive", f"the return of {node}")


def kill_stream(trial: Trial, status: FleetStatus) -> None:
    names = sorted(_on(status, "node-1", *NODES))
    if not names:
        return
    node = status.streams[str(trial.random.choice(names))].node
    actors = [each for each in trial.processes(node) if each.name().startswith("ray::StreamActor")]
    begin = monotonic()
    if actors:
        trial.random.choice(np.array(actors, object)).kill()
    hit: dict[str, StreamStatus] = {}

    def found(now: FleetStatus) -> bool:
        hit.update(
            (each, before)
            for each, before in _on(status, node).items()
            if now.streams[each].token > before.token or now.streams[each].state not in ("running", "ended")
        )
        return bool(hit)

    if trial.until(found, "the notice of a killed stream"):
        trial.recovered("process of a stream killed", hit, begin, is_process=True)


def kill_controller(trial: Trial, status: FleetStatus) -> None:
    begin = monotonic()
    for node in ("node-1", *NODES):
        for process in trial.processes(node):
            with suppress(psutil.Error):
                if process.name().startswith("ray::Controller"):
                    process.kill()
    trial.until(lambda status: status.time > 0, "the registry after the controller's return")
    trial.recovery["controller killed"].append(monotonic() - begin)
    trial.until_all_run()
    _check_untouched(trial, "controller killed", status)


def unreachable(trial: Trial, status: FleetStatus) -> None:
    trial.server.send_signal(signal.SIGSTOP)
    sleep(UNREACHABLE)
    trial.server.send_signal(signal.SIGCONT)
    _stored(trial, "store not reached for a minute", status, _on(status, "node-1", *NODES))


def _stored(trial: Trial, fault: str, before: FleetStatus, hit: dict[str, StreamStatus]) -> None:
    """Wait until the streams that were hit have stored a state again; they must have gone on."""
    begin = monotonic()

    def fresh(each: StreamStatus) -> bool:
        return each.state == "ended" or (each.stored_seconds is not None and each.stored_seconds < monotonic() - begin)

    trial.until(lambda status: all(fresh(status.streams[name]) for name in hit), f"{fault}: a new state")
    trial.recovery[fault].append(monotonic() - begin)
    _check_untouched(trial, fault, before)


def _check_untouched(trial: Trial, fault: str, before: FleetStatus) -> None:
    """All streams must go on with the same processes; a film in its last frame may only have ended."""
    ran = {name: each for name, each in before.streams.items() if each.state == "running"}

    def have_gone_on(status: FleetStatus) -> bool:
        now = status.streams
        return all(now[name].state == "ended" or now[name].frame > each.frame for name, each in ran.items())

    trial.until(have_gone_on, f"{fault}: the next frame of each stream")
    status = trial.status() or before
    again = (name for name, each in ran.items() if status.streams[name].token != each.token)
    trial.wrong += [f"{fault}: {name} was started again" for name in again]


#: Fault -> how often it occurs in 100.
FAULTS: dict[Callable[[Trial, FleetStatus], None], int] = {
    kill: 42,
    freeze: 14,
    kill_two: 14,
    kill_stream: 20,
    kill_controller: 8,
    unreachable: 2,
}


def figures(options: argparse.Namespace) -> Iterator[Table]:
    shares = {kill: 0} if options.quick else FAULTS
    faults = [fault for fault, often in shares.items() for _ in range(max(1, round(often * options.cycles / 100)))]
    live, films = (1, 1) if options.quick else (STREAMS - options.films, options.films)
    with ExitStack() as stack:
        trial = Trial(stack, options.seed, live, films, options.rate)
        order = trial.random.permutation(len(faults))
        begin = monotonic()
        for done, place in enumerate(order, start=1):
            trial.settle()
            sleep(float(trial.random.uniform(*CALM)))
            if (status := trial.status()) is None:
                trial.wrong.append("the registry did not answer")
                continue
            faults[place](trial, status)
            print(f"{done} of {len(faults)}: {faults[place].__name__}, {len(trial.wrong)} wrong", file=sys.stderr)
            print(*trial.wrong[-3:], sep="\n", end="", file=sys.stderr, flush=True)
        trial.until(
            lambda status: all(status.streams[name].state == "ended" for name in trial.lockstep), "the end of all films"
        )
        trial.settle()
        minutes = (monotonic() - begin) / 60
    yield Table(
        f"Recovery of {len(faults)} faults, 3 nodes, {len(trial.live) + len(trial.lockstep)} streams",
        ("fault", "times", "p50 s", "p99 s", "slowest s"),
        list(quantiles(trial.recovery)),
        "killed, frozen: from the fault to the next track of each stream that it hit; controller: until the registry "
        "answers; store: from its return to a new state of all streams",
    )
    yield Table(
        "Recovery from the moment at which Ray has noticed the fault",
        ("fault", "times", "p50 s", "p99 s", "slowest s"),
        list(quantiles(trial.noticed)),
    )
    yield Table(
        "SavedModel rows",
        ("films", "trees the same", "rows lost", "rows doubled", "wrong", "minutes"),
        [("in lockstep", trial.films, *([None if trial.wrong else 0] * 2), len(trial.wrong), minutes)],
        "; ".join(trial.wrong),
    )


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        cycles=(100, "number of faults"),
        films=(3, f"number of films among the {STREAMS} streams"),
        rate=(5.0, "frames/s of the live streams"),
        seed=(0, "seed of the schedule"),
    )

"""Measures what one machine pays for a fleet of many streams: the head in each turn and for each answer, and the store.

No fleet of these sizes is started: the controller's decisions, the registry's answers and the writes of states are the
real ones, of streams that do not run. Times are processor time of the process that pays them, the least of several
measurements.
"""

from __future__ import annotations

import secrets
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # shared modules of the benchmarks

from learning import features, model_of
from sequences import rendered
from table import Table, command, publish

from catstream.base.settings import Settings
from catstream.client.registry import Registry, RegistryServer
from catstream.fleet.lifecycle import Actor, Node, event, order
from catstream.fleet.spec import StreamSpec
from catstream.fleet.store import Store
from catstream.jobs.saved_model import merge
from catstream.messages.kinds import FleetStatus, StreamStatus

STREAMS = (10, 100, 1000, 10_000)
STATUS = StreamStatus(
    "camera",
    "running",
    node="node-00003",
    source="rtsp://camera-00017.example/stream",
    endpoint="tcp://10.0.0.3:5700",
    server="x" * 40,
    token=12,
    frame=1_234_567,
    models={"": 1200},
    stored_seconds=2.5,
)
_ON_A_NODE = 16  # streams
_STATE_BYTES = 14 << 20  # of a stream of four trees that has tracked for long
_WRITES = 8


def least(work: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """Milliseconds of a call, the least of five."""
    found = []
    for _ in range(5):
        began = clock()
        work()
        found.append(1000 * (clock() - began))
    return min(found)


def head(sizes: tuple[int, ...]) -> Iterator[tuple]:
    """A turn of decisions, and the answer to one question for all streams, by the number of streams."""
    for count in sizes:
        nodes = [Node(f"node-{n}", str(n), cores=float(_ON_A_NODE)) for n in range(-(-count // _ON_A_NODE))]
        wanted = [StreamSpec(f"camera-{n:05}", "demo:1") for n in range(count)]
        seen = [
            Actor("working", order=order(each, nodes), node=str(n // _ON_A_NODE), happened="reports")
            for n, each in enumerate(wanted)
        ]
        turn = least(lambda: [event(w, s, nodes, 1.0) for w, s in zip(wanted, seen, strict=True)])  # noqa: B023
        streams = {name: replace(STATUS, name=name) for name in (f"camera-{n:05}" for n in range(count))}
        yield count, turn, answered(FleetStatus("scale", time.time(), streams))


def answered(status: FleetStatus) -> float:
    """Milliseconds until a client has the state of all streams, from a registry in this process."""
    over = False

    def serve(server: RegistryServer) -> None:
        while not over:
            server.turn(0.05)

    with (
        tempfile.TemporaryDirectory() as folder,
        ThreadPoolExecutor(1) as pool,
        RegistryServer(f"{folder}/r", "", lambda: status) as server,
    ):
        serving = pool.submit(serve, server)
        with Registry("scale", timeout=60) as registry:
            found = least(registry.streams, time.perf_counter)
        over = True
        serving.result()
    return found


def store() -> Iterator[tuple]:
    """A state that is written to a folder, and its bytes."""
    with tempfile.TemporaryDirectory() as folder:
        claim = Store(folder).stream("camera").claim("node")
        files = {"trees/1.safetensors": secrets.token_bytes(_STATE_BYTES)}
        write = least(lambda: [claim.write(files, {}) for _ in range(_WRITES)]) / _WRITES
        yield "a state is written", write, _STATE_BYTES / 2**20
    film = rendered(61)
    models = [model_of(features(film, start, 60, Settings()), Settings()) for start in (0, 1)]
    yield "two saved models are merged", least(lambda: merge(models, force=True)), len(models[0].to_bytes()) / 2**20


def figures(sizes: tuple[int, ...]) -> Iterator[Table]:
    """The tables of the head and of a node."""
    yield Table("the head", ("streams", "decisions of a turn ms", "all are answered ms"), list(head(sizes)))
    yield Table("a node", ("work", "processor ms", "MB"), list(store()))


if __name__ == "__main__":
    options = command(__doc__).parse_args()
    publish(figures(STREAMS[:2] if options.quick else STREAMS), options)

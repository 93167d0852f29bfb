"""Measures the costs on one machine from which `simulate.py` computes larger fleets.

A cost is the processor time of the process that pays it, and the least of several measurements, so it depends little on
other work of the machine. Some costs need Ray; `--quick` leaves them out.
"""

from __future__ import annotations

import argparse
import os
import resource
import secrets
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any
from uuid import uuid4

import psutil

sys.path.append(str(Path(__file__).parents[1]))  # shared modules of the benchmarks

from learning import features, model_of
from sequences import rendered, scratch
from table import Table, command, publish

from catstream.fleet.placement import Node
from catstream.fleet.reconcile import Actor, Desired, Memory, reconcile
from catstream.learned import merge
from catstream.messages import FleetStatus, Listing, Question, StreamStatus
from catstream.registry import RegistryServer
from catstream.settings import Settings
from catstream.video.demo import write
from catstream.wire.channels import REGISTRY
from catstream.wire.codec import decode, encode
from catstream.wire.commands import Requester

_GROUPS, _ACTORS = 4, 4  # actors are created in groups of this size
_ROUNDS, _REPEATS = 50, 5
_CORES = 0.4  # of a stream
_PART = 200  # streams in the measured answer
_SLOTS, _RACK = 64, 10  # streams of a machine and machines of a rack in the measured decisions
STATUS = StreamStatus(
    "camera-00017",
    "running",
    node="node-00003",
    source="rtsp://camera-00017.example/stream",
    endpoint="tcp://10.0.0.3:5700",
    server="x" * 40,
    token=12,
    frame=1_234_567,
    rate=25.0,
    cores=_CORES,
    models={"": 1200},
    stored_seconds=2.5,
)


def processor(work: Callable[[], object], rounds: int) -> float:
    """Milliseconds of processor of one call: the least of five measurements, as others use the machine too."""
    found = []
    for _ in range(5):
        began = time.process_time()
        for _ in range(rounds):
            work()
        found.append(1000 * (time.process_time() - began) / rounds)
    return min(found)


def messages(rounds: int) -> Iterator[tuple]:
    """A page's part of an answer for all streams."""
    part = Listing("1", "site", 0.0, {name: replace(STATUS, name=name) for name in _names(_PART)})
    data = encode(part)
    read = processor(lambda: decode(data, Listing), rounds) / _PART
    yield "listing_read", read, "ms", "page: a stream in an answer for all, read and checked"
    yield "listing_bytes", len(data) / _PART, "bytes", "a stream in an answer for all"


def answers(cameras: int) -> Iterator[float]:
    """Milliseconds of processor in which the registry answers a question for one stream, and one for all streams.

    An answer has at most 256 streams; the time is that of one answer.
    """
    names = _names(cameras)

    def status() -> FleetStatus:
        return FleetStatus("costs", 0.0, {name: replace(STATUS, name=name) for name in names})

    with (
        RegistryServer("", "", status) as server,
        closing(Requester[Question, Listing](REGISTRY, server.endpoint)) as requester,
    ):
        for stream in (names[0], ""):
            yield min(_answered(server, requester, stream) for _ in range(_REPEATS))


def _answered(server: RegistryServer, requester: Requester[Question, Listing], stream: str) -> float:
    question = Question(uuid4().hex, stream)
    while True:
        requester.send(question)  # it is dropped before there is a connection
        began = time.thread_time()
        answered = server.turn(0.1)
        spent = time.thread_time() - began
        if answered:
            requester.receive(question.id, 10.0)
            return 1000 * spent


def _names(cameras: int) -> list[str]:
    return [f"camera-{number:06}" for number in range(cameras)]


def pipeline(frames: int) -> Iterator[tuple]:
    """Processor time of a short run of the three processes."""
    video, truth = write(scratch() / "start", frames, (320, 240))
    words = [sys.executable, "-P", "-c", "from catstream.cli import main; main()", "track", str(video)]
    words += ["--box", str(truth[0])]
    found = []
    for run in ("first", "second", "third"):  # the first one may compile kernels
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*words, "--output", str(scratch() / run)], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    yield "start_cpu", 1000 * min(found), "ms", f"node: a pipeline of {frames} frames, from start to end"


def merging(frames: int) -> Iterator[tuple]:
    """Processor time of a merge of two saved models."""
    sequence, settings = rendered(2 * frames, (320, 240)), Settings()
    halves = [model_of(features(sequence, start, frames, settings), settings) for start in (0, frames)]
    yield "merge", processor(lambda: merge(halves), 1), "ms", f"two saved models of {frames} frames each"


def ray_costs() -> Iterator[tuple]:
    """Measure the memory and the processor time of Ray's processes and of an actor in the place of the manager."""
    token = scratch() / "token"
    token.write_text(secrets.token_hex(24))
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token), "RAY_USAGE_STATS_ENABLED": "0"}
    import ray

    class Stream:
        def status(self) -> StreamStatus:
            return STATUS

        def send(self, manager: Any, times: int) -> None:
            for _ in range(times):
                ray.get(manager.take.remote(STATUS))

    class Manager:
        def ask(self, streams: Sequence[Any], times: int = 1) -> None:
            for _ in range(times):
                for answer in [stream.status.remote() for stream in streams]:
                    ray.wait([answer])  # one by one, as the manager does it
                    ray.get(answer)

        def take(self, _: StreamStatus) -> None:
            pass

        def create(self, number: int) -> list[Any]:
            streams = [ray.remote(Stream).options(num_cpus=0).remote() for _ in range(number)]
            self.ask(streams)
            return streams

        def seconds(self) -> float:
            return time.process_time()

    ray.init(address="local", num_cpus=0, include_dashboard=False, log_to_driver=False, object_store_memory=100_000_000)
    try:
        manager = ray.remote(Manager).options(num_cpus=0).remote()

        def spent(work: Callable[[], object]) -> float:
            before = ray.get(manager.seconds.remote())
            work()
            return 1000 * (ray.get(manager.seconds.remote()) - before)

        ray.get(manager.create.remote(1))
        streams: list[Any] = []
        server = next(one for one in psutil.Process().children(recursive=True) if "gcs_server" in one.name())
        create, gcs = [], []
        for _ in range(_GROUPS):
            before = server.cpu_times()
            create.append(spent(lambda: streams.extend(ray.get(manager.create.remote(_ACTORS)))) / _ACTORS)
            after = server.cpu_times()
            gcs.append(1000 * (after.user + after.system - before.user - before.system) / _ACTORS)
        yield "create", min(create), "ms", "manager: an actor is created, and answers once"
        yield "gcs_create", min(gcs), "ms", "head's Ray server: an actor is created"
        asked = min(spent(lambda: ray.get(manager.ask.remote(streams, _ROUNDS))) for _ in range(_REPEATS))
        yield "status", asked / _ROUNDS / len(streams), "ms", "manager: the status of a stream, asked for"
        sent = min(
            spent(lambda: ray.get([stream.send.remote(manager, _ROUNDS) for stream in streams[:2]]))
            for _ in range(_REPEATS)
        )
        yield "pushed", sent / _ROUNDS / 2, "ms", "manager: the status of a stream, sent by the stream"
        ours = psutil.Process().children(recursive=True)
        workers = [one for one in ours if one.name().startswith("ray::Stream")]
        seconds = [1000 * sum(one.cpu_times()[:2]) for one in workers[2:]]  # two of them have sent their status
        yield "worker", min(seconds), "ms", "node: the process of an actor, from its start to its first answers"
        yield "worker_memory", median(one.memory_full_info().uss for one in workers), "bytes", "node: its memory"
    finally:
        ray.shutdown()


def by_streams(sizes: Sequence[int]) -> Iterator[tuple]:
    """Processor time of `reconcile`, if nothing changes and after the loss of a rack; and of two answers."""
    for cameras in sizes:
        machines = cameras // _SLOTS + 1
        desired = {name: Desired("1", _CORES) for name in _names(cameras)}
        actors = {name: Actor(f"node-{k // _SLOTS:05}", "1", "running", 0.0) for k, name in enumerate(desired)}
        nodes = [Node(f"node-{k:05}", _SLOTS * _CORES) for k in range(machines + _RACK)]
        memory = reconcile(Memory(), desired, nodes, actors, 1.0).memory
        rest = [replace(node, alive=False) if number < _RACK else node for number, node in enumerate(nodes)]
        left = {name: actor for k, (name, actor) in enumerate(actors.items()) if k >= _RACK * _SLOTS}
        yield (
            cameras,
            machines + _RACK,
            min(len(desired), _RACK * _SLOTS),
            processor(partial(reconcile, memory, desired, nodes, actors, 2.0), 1),
            processor(partial(reconcile, memory, desired, rest, left, 2.0), 1),
            *answers(cameras),
        )


def figures(options: argparse.Namespace) -> Iterator[Table]:
    rows = [*messages(1 if options.quick else 50), *pipeline(3 if options.quick else 10)]
    if not options.quick:
        rows += [*merging(60), *ray_costs()]
    yield Table("Costs on one machine", ("cost", "value", "unit", "of"), rows)
    heads = (
        "streams",
        "machines",
        "streams of a rack",
        "decision, ms",
        "a rack is lost, ms",
        "answer for one, ms",
        "for all, ms",
    )
    sizes = (50,) if options.quick else (1000, 3000, 10_000, 30_000, 100_000)
    yield Table("By number of streams", heads, list(by_streams(sizes)))


if __name__ == "__main__":
    options = command(__doc__).parse_args()
    publish(figures(options), options)

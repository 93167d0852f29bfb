"""One run of a load test on a fleet of its own: a head and several nodes on this machine.

Latency, lost frames and recovery are those that a subscriber to `fleet://FLEET/STREAM` sees while streams move from a
killed node to another one.
"""

from __future__ import annotations

import asyncio
import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

from catstream.errors import CatstreamError, FleetError, SilenceError
from catstream.fleet.fleet import Fleet
from catstream.fleet.local import LocalFleet
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.loadtest.camera import Camera
from catstream.loadtest.chaos import NodeChaos
from catstream.loadtest.measures import measure
from catstream.loadtest.nodes import kill_node, processes
from catstream.loadtest.observer import Observations
from catstream.loadtest.plan import NO_NODE_KILL_SECONDS, Plan
from catstream.loadtest.run import LEAD_SECONDS, Monitor, Result, Status, recovery, wait_until
from catstream.messages import FleetStatus, StreamStatus
from catstream.registry import Registry, address_of
from catstream.settings import Settings
from catstream.subscription import Subscription
from catstream.video.broadcast import Schedule

__all__ = ["run_on_fleet"]

_NAME = "load-test"
_CHANNELS = ("tracks", "models", "health")
_LOOK_SECONDS = 0.1  # between two questions to the registry
_ANSWER_SECONDS = 2.0  # limit for the registry to answer


def run_on_fleet(plan: Plan, camera: Camera, report_status: Callable[[Status], None] = lambda _: None) -> Result:
    """Run the pipelines as the streams of a new fleet, and measure; the fleet is stopped and removed afterwards.

    The parameters are those of `run`.

    Raises
    ------
    CatstreamError
        If the fleet or a stream cannot start.
    MissingExtraError
        If Ray is not installed.
    """
    camera.show_still()
    names = [f"stream-{number}" for number in range(plan.streams)]
    report_status(Status("starting the nodes", 0.0))
    with ExitStack() as stack:
        local = stack.enter_context(_fleet(plan, dict(zip(names, camera.urls, strict=True)), camera))
        watcher = _Watcher(local, names, plan)
        stack.callback(watcher.end)
        watcher.start()
        wait_until(
            lambda: all(each.state == "running" for each in watcher.statuses),
            watcher.errors,
            "starting streams",
            report_status,
        )
        observer = _Observer(names)
        stack.callback(observer.end)
        observer.start()
        seen = observer.observations
        wait_until(lambda: all(each.warmed_up for each in seen), watcher.errors, "learning", report_status)
        schedules = camera.play(Schedule(monotonic() + LEAD_SECONDS, plan.rate, plan.frames))
        watcher.last_kill = schedules[-1].due(plan.frames - 1) - NO_NODE_KILL_SECONDS
        monitor = Monitor(plan, camera, seen, watcher.kills, watcher.is_alive, lambda: _pids(local))
        interrupted = False
        try:
            monitor.run(schedules, report_status)
        except KeyboardInterrupt:
            interrupted = True
        end, late = monotonic(), camera.late
        report_status(Status("ending", 1.0))
    due = [min(plan.frames, schedule.following(end)) if interrupted else plan.frames for schedule in schedules]
    if not all(number > 0 for number in due):
        raise KeyboardInterrupt
    return Result(
        plan=plan,
        seconds=min(due) / plan.rate,
        streams=[
            measure(observations, schedule, number, camera.truth, end, {})
            for observations, schedule, number in zip(seen, schedules, due, strict=True)
        ],
        restarts=sum(status.restarts for status in watcher.statuses),
        recoveries=[recovery(kill, seen[kill.stream]) for kill in watcher.kills],
        usage=monitor.usage.readings,
        received=[],
        missed=[],
        frozen=0.0,
        camera_late=late,
        errors=[str(error) for error in watcher.errors()],
        statuses=watcher.statuses,
        interrupted=interrupted,
    )


@contextmanager
def _fleet(plan: Plan, sources: dict[str, str], camera: Camera) -> Iterator[LocalFleet]:
    """Start a fleet in a temporary folder. All that its processes leave behind if they are killed is in the folder."""
    default = Settings().values()
    settings: dict[str, object] = {
        name: value for name, value in plan.settings.values().items() if value != default[name]
    }
    streams = {name: StreamSpec(name, url, camera.boxes, settings=settings, cores=1.0) for name, url in sources.items()}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="cs-", ignore_cleanup_errors=True)))
        stack.enter_context(_environment(XDG_RUNTIME_DIR=str(folder), TMPDIR=str(folder)))
        local = LocalFleet(folder / "fleet")
        stack.callback(local.stop)
        local.start(plan.nodes, _cores(plan))
        with Fleet(FleetSpec(_NAME, nodes=plan.nodes, streams=streams), folder=local.folder) as fleet:
            fleet.up(nodes=plan.nodes, cores=_cores(plan))
        yield local


def _cores(plan: Plan) -> float:
    """Cores of each node, so that the other nodes have room for the streams of a dead one; a stream needs one core."""
    return float(math.ceil(plan.streams / max(1, plan.nodes - 1)))


@contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Set environment variables of this process for a while."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _pids(local: LocalFleet) -> dict[str, list[int]]:
    """Ids of the processes of the head and of each node, with the pipelines that run there."""
    found = {}
    for name in ("head", *local.names):
        with suppress(FleetError):  # it was killed meanwhile
            found[name] = processes(local, name)
    return found


class _Watcher(threading.Thread):
    """A thread that asks the registry for the state of the streams, and kills nodes if the plan says so.

    Attributes
    ----------
    statuses : last state of each stream
    kills : the kills so far
    last_kill : moment after which no node is killed, by `time.monotonic`; none is killed while it is 0
    """

    def __init__(self, local: LocalFleet, names: list[str], plan: Plan) -> None:
        super().__init__(name="watcher", daemon=True)
        self.statuses = [StreamStatus(name, "starting") for name in names]
        self.last_kill = 0.0
        self._ended, self._failure = threading.Event(), ""
        self._kill_nodes = plan.kill_nodes
        self._chaos = NodeChaos(
            plan.settings.run.seed,
            names,
            lambda node: kill_node(local, node),
            lambda node: local.start_node(node, _cores(plan)),
        )
        self.kills = self._chaos.kills

    def run(self) -> None:
        try:
            with Registry(_NAME, timeout=_ANSWER_SECONDS) as registry:
                while not self._ended.wait(_LOOK_SECONDS):
                    with suppress(SilenceError):  # it is asked again
                        self._take(registry.streams())
        except CatstreamError as error:
            self._failure = str(error)

    def errors(self) -> list[FleetError]:
        """The reasons why streams do not run now."""
        failed = [f"{each.name}: {each.trouble}" for each in self.statuses if each.state == "failed"]
        return [FleetError(text) for text in (self._failure, *failed) if text]

    def end(self) -> None:
        self._ended.set()
        self.join()

    def _take(self, status: FleetStatus) -> None:
        self.statuses = [status.streams.get(each.name, each) for each in self.statuses]
        if self._kill_nodes and self.last_kill:
            self._chaos.step(status, may_kill=monotonic() < self.last_kill)


class _Observer(threading.Thread):
    """A thread that subscribes to the streams, wherever they run, until `end` is called.

    Attributes
    ----------
    observations : observations of each stream
    """

    def __init__(self, names: list[str]) -> None:
        super().__init__(name="observer", daemon=True)
        self.observations = [Observations() for _ in names]
        self._addresses = [address_of(_NAME, name) for name in names]
        self._ended = threading.Event()

    def run(self) -> None:
        asyncio.run(self._observe())

    def end(self) -> None:
        self._ended.set()
        self.join()

    async def _observe(self) -> None:
        tasks = [
            asyncio.create_task(_receive(address, channel, observations))
            for address, observations in zip(self._addresses, self.observations, strict=True)
            for channel in _CHANNELS
        ]
        while not self._ended.is_set():
            await asyncio.sleep(_LOOK_SECONDS)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _receive(address: str, channel: str, observations: Observations) -> None:
    """Receive the messages of one channel of a stream until the stream ends."""
    with Subscription[Any](address, channel) as messages:
        async for message in messages:
            observations.add(monotonic(), message)

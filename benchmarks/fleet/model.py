"""Sizes a fleet from measured costs: machines, load of the store and of the head, price; arithmetic only.

`Costs` is measured and read from the records in `benchmarks/results`. `Site`, `Faults` and `Prices` are assumptions
about the place where a fleet runs; change them for yours.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

__all__ = ["GB", "PERIOD", "Costs", "Faults", "Prices", "Site", "Size", "explained"]

PERIOD = 0.5  #: seconds from one observation of the manager to the next: it observes twice a second
_ANSWERS = 20  # times per second that the manager looks at questions, and answers all that wait at once
_LISTED = 256  # streams in an answer
_MONTH = 30 * 86400.0  # seconds
GB = 1e9


@dataclass(frozen=True, slots=True)
class Costs:
    """The measured costs of one machine.

    cores            of one stream, three processes
    memory           of one stream in bytes, with the process of its Ray actor
    state            bytes of a state after a million messages
    status           manager: seconds of processor to ask one stream for its status
    pushed           manager: seconds of processor to take a status that a stream sends by itself
    create           manager: seconds of processor to create one actor
    gcs_create       head's Ray server: seconds of processor to create one actor
    worker           node: seconds of processor until the process of an actor runs
    start            node: seconds from the command to the first track
    start_cpu        node: seconds of processor until the first track
    by_streams       for each measured number of streams, a row: this number, the streams of a rack, and seconds of
                     processor of a decision that changes nothing, of a decision after the loss of a rack, of an answer
                     about one stream, and of one of the answers about all streams
    """

    cores: float
    memory: float
    state: float
    status: float
    pushed: float
    create: float
    gcs_create: float
    worker: float
    start: float
    start_cpu: float
    by_streams: tuple[tuple[float, ...], ...]

    @classmethod
    def read(cls, records: Mapping[str, Any]) -> Self:
        """Return the costs in the records `fleet_costs`, `loadtest`, `soak` and `startup`."""
        unit = {row[0]: row[1] for row in records["fleet_costs"]["tables"][0]["rows"]}
        rows = records["fleet_costs"]["tables"][1]["rows"]
        measured = [(row[0], row[2], *(milliseconds / 1000 for milliseconds in row[3:])) for row in rows]
        load = records["loadtest"]["processes"]
        processes = [load[f"{name} 0"] for name in ("detector", "compressor", "trainer")]
        soak, startup = (records[name]["tables"][0] for name in ("soak", "startup"))
        warm = next(row for row in startup["rows"] if row[0] == "warm")
        return cls(
            cores=sum(process["cores"] for process in processes),
            memory=sum(process["memory_most"] for process in processes) + unit["worker_memory"],
            state=soak["rows"][-1][soak["columns"].index("disk MB")] * 1e6,
            start=warm[startup["columns"].index("first track, s")],
            by_streams=tuple(measured),
            **{name: unit[name] / 1000 for name in _MILLISECONDS},
        )

    def decision(self, cameras: float, lost: int = 0) -> float:
        """Seconds of processor of a decision, interpolated between the measured numbers of streams.

        Parameters
        ----------
        lost : streams that have to be placed
        """
        _, moved, unchanged, changed, *_ = zip(*self.by_streams, strict=True)
        each = [max(after - before, 0) / rack for rack, before, after in zip(moved, unchanged, changed, strict=True)]
        return self._at(cameras, unchanged) + self._at(cameras, each) * lost

    def answer(self, cameras: float, *, about_all: bool) -> float:
        """Seconds of processor of an answer about one stream, or of one of those about all streams."""
        columns = list(zip(*self.by_streams, strict=True))
        return self._at(cameras, columns[5 if about_all else 4])

    def _at(self, cameras: float, seconds: Sequence[float]) -> float:
        sizes = [row[0] for row in self.by_streams]
        return float(np.interp(cameras, [0, *sizes], [0, *seconds])) * max(1.0, cameras / sizes[-1])


_MILLISECONDS = ("status", "pushed", "create", "gcs_create", "worker", "start_cpu")


@dataclass(frozen=True, slots=True)
class Site:
    """Assumptions about the machines, the network and the use of a fleet.

    cores          cores of a machine
    memory         GB of a machine
    fill           share of the cores that placement gives away; the rest is for searches of the whole frame
    rack           machines that share power and a switch
    spare          share of all machines that are spare, besides one rack
    rate           frames per second of a camera
    store          GB per second of the store: 100 Gbit/s, as four machines with 25 Gbit/s each
    connection     GB per second of one transfer
    latency        seconds of one request to the store
    every          seconds between two states of a stream
    pushed         whether streams send their status by themselves, or else are asked for it twice a second
    report         seconds between two reports of a stream that sends its status
    pages          open pages of all streams; each asks for all of them once per second
    questions      questions per second and stream, from subscribers that look a stream up
    fullest_first  whether a stream goes to the fullest machine with enough free cores, or else to the emptiest
    heads          independent heads; each has an equal part of the cameras
    """

    cores: int = 32
    memory: float = 64.0
    fill: float = 0.8
    rack: int = 10
    spare: float = 0.01
    rate: float = 25.0
    store: float = 12.5
    connection: float = 0.1
    latency: float = 0.03
    every: float = 5.0
    pushed: bool = False
    report: float = 5.0
    pages: int = 2
    questions: float = 0.01
    fullest_first: bool = False
    heads: int = 1


@dataclass(frozen=True, slots=True)
class Faults:
    """Assumptions about failures: how often each thing fails, and how long it is away.

    machine_days  days between two failures of one machine, on average
    machine_back  seconds until it is back
    rack_days     days between two failures of one rack, on average
    rack_back     seconds until it is back
    head_days     days between two failures of a head, on average
    head_back     seconds until its keeper has started it again
    store_days    days between two times at which the store is away, on average
    store_back    seconds until it is back
    """

    machine_days: float = 365.0
    machine_back: float = 4 * 3600.0
    rack_days: float = 3 * 365.0
    rack_back: float = 4 * 3600.0
    head_days: float = 90.0
    head_back: float = 15.0
    store_days: float = 30.0
    store_back: float = 60.0


@dataclass(frozen=True, slots=True)
class Prices:
    """List prices of one provider at one date, without a discount.

    date     year and month of the prices
    machine  dollars for an hour of a machine with 32 virtual cores and 64 GB
    put      dollars for a million requests that write
    get      dollars for a million requests that read
    stored   dollars for a GB in the store for a month
    """

    date: str = "2025-06"
    machine: float = 1.428
    put: float = 5.0
    get: float = 0.4
    stored: float = 0.023


def explained(values: Site | Faults | Prices) -> list[tuple[str, Any, str]]:
    """Return name, value and meaning of each assumption."""
    meanings = dict(re.findall(r"^    (\w+)  +(.+)$", type(values).__doc__ or "", re.MULTILINE))
    return [(field.name, getattr(values, field.name), meanings[field.name]) for field in fields(values)]


@dataclass(frozen=True, slots=True)
class Size:
    """A fleet of a number of cameras at a site."""

    cameras: int
    costs: Costs
    site: Site

    @property
    def slots(self) -> int:
        """Streams that fit on a machine, by its cores and its memory."""
        by_cores = self.site.cores * self.site.fill / self.costs.cores
        return max(1, int(min(by_cores, self.site.memory * GB / self.costs.memory)))

    @property
    def machines(self) -> int:
        """Machines for all streams, a spare rack, and the other spare ones."""
        return math.ceil(self.cameras / self.slots * (1 + self.site.spare)) + self.site.rack

    @property
    def writes(self) -> float:
        """States per second that are written to the store."""
        return self.cameras / self.site.every

    @property
    def store_load(self) -> float:
        """Bytes per second that are written to the store."""
        return self.writes * self.costs.state

    @property
    def interval(self) -> float:
        """Seconds between two states of a stream: longer than `every` if the store is too slow."""
        return max(self.site.every, self.cameras * self.costs.state / (self.site.store * GB))

    def head(self) -> dict[str, float]:
        """Share of one core that each task of one head's manager takes."""
        cameras, site, costs = math.ceil(self.cameras / self.site.heads), self.site, self.costs
        statuses = costs.pushed / site.report if site.pushed else costs.status / PERIOD
        return {
            "statuses": cameras * statuses,
            "decisions": costs.decision(cameras) / PERIOD,
            "questions": min(cameras * site.questions, _ANSWERS) * costs.answer(cameras, about_all=False),
            "pages": site.pages * self.page,
        }

    def calls(self) -> float:
        """Calls per second at one head: statuses and questions."""
        cameras, site = self.cameras / self.site.heads, self.site
        return cameras * (1 / site.report if site.pushed else 1 / PERIOD) + cameras * site.questions + site.pages

    @property
    def page(self) -> float:
        """Seconds of the manager's processor for all answers to one page of all streams."""
        cameras = math.ceil(self.cameras / self.site.heads)
        return math.ceil(cameras / _LISTED) * self.costs.answer(cameras, about_all=True)

    @property
    def turn(self) -> float:
        """Seconds that one turn of the manager takes: what it does for all streams before it can start any."""
        return sum(self.head().values()) * PERIOD

    def price(self, prices: Prices) -> dict[str, float]:
        """Dollars for a month, by what they are paid for.

        A state is written with one request, and checked with another one; the newest two of each stream are kept.
        """
        hours = _MONTH / 3600
        return {
            "machines": (self.machines + self.site.heads) * hours * prices.machine,
            "requests": self.writes * _MONTH / 1e6 * (prices.put + prices.get),
            "stored": 2 * self.cameras * self.costs.state / GB * prices.stored,
        }

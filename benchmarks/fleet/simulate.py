"""Simulates fleets of 1,000 to 100,000 cameras, with what was measured on one machine.

The costs of one stream are read from the records in `benchmarks/results`; `model.py` has the assumptions about
machines, network, failures and prices, and `recovery.py` simulates failures event by event. The same seed gives the
same figures. See `docs/scale.md`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))  # shared modules of the benchmarks

from model import GB, PERIOD, Costs, Faults, Prices, Site, Size, explained
from recovery import HeadLost, NodesLost, Outcome, StoreLost, simulate
from sections import records
from table import Table, command, publish

CAMERAS = (1000, 3000, 10_000, 30_000, 100_000)
YEAR = 365 * 86400.0
_DAY = 86400.0
_AT, _WATCHED = 61.3, 1800.0  # time of the faults of a scenario, and its end, in seconds
_YOUNG_STATE = 20e6  # bytes, of a stream that has tracked for some hundred frames
_MOST = 300_000  # cameras up to which limits are searched
#: Seconds in which the streams of a machine (99 of 100) and of a rack (all of them) have to be back.
MACHINE_BACK, RACK_BACK = 15.0, 60.0

#: What can be changed against a limit, and how: settings of the fleet, not of the machines.
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "as built": {},
    "every = 30": {"every": 30.0},
    "statuses are sent": {"pushed": True},
    "both": {"every": 30.0, "pushed": True},
    "both, 10 heads": {"every": 30.0, "pushed": True, "heads": 10},
    "... and S3": {"every": 30.0, "pushed": True, "heads": 10, "store": 1e6},
}


def assumptions(prices: Prices) -> Table:
    """All values that were not measured."""
    rows = [row for values in (Site(), Faults(), prices) for row in explained(values)]
    return Table("Assumptions", ("assumption", "value", "meaning"), rows)


def sizes(costs: Costs, prices: Prices, cameras: Sequence[int], variant: str) -> Table:
    """Machines, loads and price of fleets."""
    site = replace(Site(), **VARIANTS[variant])
    columns = ("cameras", "machines", "states/s", "GB/s", "M requests", "calls/s", "core", "$", "$ requests", "$ each")
    rows = []
    for number in cameras:
        size = Size(number, costs, site)
        price, month = size.price(prices), size.writes * 30 * _DAY / 1e6
        share, total = sum(size.head().values()), sum(price.values())
        load = (size.writes, size.store_load / GB, month, size.calls(), share)
        rows.append((number, size.machines, *load, total, price["requests"], total / number))
    return Table(f"Fleets, {variant}", columns, rows, f"prices of {prices.date}; requests and $: for 30 days")


def head_parts(costs: Costs, cameras: Sequence[int]) -> Table:
    """Share of a core that each task of the manager takes."""
    parts = [Size(number, costs, Site()).head() for number in cameras]
    rows = [
        (number, *part.values(), Size(number, costs, Site()).turn) for number, part in zip(cameras, parts, strict=True)
    ]
    return Table(
        "Manager, share of one core", ("cameras", *parts[0], "a turn, s"), rows, "above 1, the turns become longer"
    )


def scenarios(size: Size) -> dict[str, list[NodesLost | HeadLost | StoreLost]]:
    """Return the faults of each scenario."""
    hours = _WATCHED
    rack = NodesLost(_AT, range(size.site.rack), hours)
    return {
        "a machine: Ray killed": [NodesLost(_AT, range(1), hours, silent=False)],
        "a machine: no power": [NodesLost(_AT, range(1), hours)],
        "a rack": [rack],
        "a rack, while the head restarts": [HeadLost(_AT - 1, Faults().head_back), rack],
        "a rack, while the store is away": [StoreLost(_AT - 1, Faults().store_back), rack],
    }


def recoveries(costs: Costs, cameras: Sequence[int], seed: int) -> Table:
    """Time to recover in each scenario."""
    rows = []
    for number in cameras:
        size = Size(number, costs, Site())
        for name, faults in scenarios(size).items():
            found = simulate(size, faults, seed, _WATCHED)
            rows.append((number, name, len(found.down), *_spread(found), *_losses(found, size), found.waiting))
    columns = ("cameras", "lost", "streams", "p50 s", "p99 s", "last s", "frames each", "learning s", "not back")
    return Table("Until the streams are back", columns, rows, "frames each: frames of the camera that were not tracked")


def _spread(found: Outcome) -> tuple[float, float, float]:
    return tuple(map(float, np.percentile(found.down or [0.0], (50, 99, 100))))


def _losses(found: Outcome, size: Size) -> tuple[float, float]:
    """Frames that were not tracked and seconds whose learning was lost, for each stream that failed."""
    failures = max(len(found.unlearnt), 1)
    return sum(found.down) * size.site.rate / failures, sum(found.unlearnt) / failures


def year(size: Size, faults: Faults, seed: int) -> list[NodesLost | HeadLost | StoreLost]:
    """Return the random failures of a year: each thing fails at times that do not depend on the others."""
    chance, rack = Random(seed), size.site.rack

    def times(days: float) -> Iterator[float]:
        now = chance.expovariate(1 / (days * _DAY))
        while now < YEAR:
            yield now
            now += chance.expovariate(1 / (days * _DAY))

    found: list[NodesLost | HeadLost | StoreLost] = []
    for number in range(size.machines):
        found += [NodesLost(at, range(number, number + 1), faults.machine_back) for at in times(faults.machine_days)]
    for first in range(0, size.machines, rack):
        nodes = range(first, min(first + rack, size.machines))
        found += [NodesLost(at, nodes, faults.rack_back) for at in times(faults.rack_days)]
    found += [HeadLost(at, faults.head_back) for at in times(faults.head_days)]
    found += [StoreLost(at, faults.store_back) for at in times(faults.store_days)]
    return sorted(found, key=lambda fault: fault.at)


def years(costs: Costs, cameras: Sequence[int], faults: Faults, seed: int) -> Table:
    """A year of random failures."""
    rows = []
    for number in cameras:
        size = Size(number, costs, Site())
        happened = year(size, faults, seed)
        found = simulate(size, happened, seed, YEAR + _DAY)
        lost = [fault for fault in happened if isinstance(fault, NodesLost)]
        racks = sum(len(fault.nodes) > 1 for fault in lost)
        down = sum(found.down) / number
        counts = (len(lost) - racks, racks, len(found.down))
        rows.append((number, *counts, *_spread(found)[:2], down, down * size.site.rate))
    heads = ("machines lost", "racks lost", "recoveries", "p50 s", "p99 s", "down s each", "frames each")
    return Table("A year of failures", ("cameras", *heads), rows, "each: of each camera, in the year")


def most(met: Callable[[int], bool]) -> int | None:
    """Return the largest number of cameras, to two digits, up to which a limit is met; None if there is none."""
    low, high = 1, _MOST
    if met(high):
        return None
    while high - low > max(low // 100, 1):
        middle = int((low * high) ** 0.5) if high > 2 * low else (low + high) // 2
        low, high = (middle, high) if met(middle) else (low, middle)
    digits = 10 ** max(len(str(low)) - 2, 0)
    return low // digits * digits


def limits(costs: Costs, site: Site, seed: int) -> dict[str, int | None]:
    """Return the number of cameras up to which each limit is met."""

    def recovered(cameras: int, lost: str, percentile: int, seconds: float) -> bool:
        found = simulate(size(cameras), scenarios(size(cameras))[lost], seed, _WATCHED)
        return not found.waiting and bool(np.percentile(found.down, percentile) <= seconds)

    def size(cameras: int) -> Size:
        return Size(cameras, costs, site)

    return {
        f"a turn of the manager takes at most {PERIOD:g} s": most(lambda n: size(n).turn <= PERIOD),
        "the store takes all states in time": most(lambda n: size(n).store_load <= site.store * GB),
        "a page of all streams is answered in 1 s": most(lambda n: size(n).page <= 1.0),
        f"streams of a killed machine are back in {MACHINE_BACK:g} s": most(
            lambda n: recovered(n, "a machine: Ray killed", 99, MACHINE_BACK)
        ),
        f"streams of a rack are back in {RACK_BACK:g} s": most(lambda n: recovered(n, "a rack", 100, RACK_BACK)),
        "actors: Ray's scalability tests": 20_000 * site.heads,
        "machines: Ray's scalability tests": 3_000 * site.heads * Size(1, costs, site).slots,
    }


def breaking(costs: Costs, prices: Prices, seed: int) -> Table:
    """Return the first limit that each variant reaches."""
    found = {name: limits(costs, replace(Site(), **changes), seed) for name, changes in VARIANTS.items()}
    rows: list[tuple] = [(limit, *(found[name][limit] for name in VARIANTS)) for limit in found["as built"]]
    firsts = [min(number for number in found[name].values() if number is not None) for name in VARIANTS]
    rows.append(("all of them", *firsts))
    each = [Size(100_000, costs, replace(Site(), **changes)).price(prices) for changes in VARIANTS.values()]
    rows.append(("$ a month for each camera, of 100,000", *(sum(price.values()) / 100_000 for price in each)))
    return Table("Cameras up to which a limit is met", ("limit", *VARIANTS), rows, "-: above 300,000")


def course(costs: Costs, cameras: Sequence[int], seed: int) -> Table:
    """Share of a lost rack's streams that are back, over time, for three sizes of a fleet."""
    seconds = [float(second) for second in range(0, 121, 2)]
    columns: dict[str, list[float]] = {}
    for variant in ("as built", "both, 10 heads"):
        for number in (cameras[0], cameras[len(cameras) // 2], cameras[-2]):
            size = Size(number, costs, replace(Site(), **VARIANTS[variant]))
            found = simulate(size, scenarios(size)["a rack"], seed, _WATCHED)
            down, lost = np.sort(found.down), max(len(found.unlearnt), 1)
            columns[f"{number:,}, {variant}"] = [
                float(np.searchsorted(down, second, "right")) / lost for second in seconds
            ]
    rows = [list(row) for row in zip(seconds, *columns.values(), strict=True)]
    return Table("Share of a rack's streams that are back", ("s", *columns), rows)


def placing(costs: Costs, cameras: Sequence[int], seed: int) -> Table:
    """A rack's recovery if streams go to the emptiest machine, and if they go to the fullest one with room."""
    rows = []
    for number in cameras:
        for name, fullest in (("the emptiest", False), ("the fullest", True)):
            size = Size(number, costs, Site(fullest_first=fullest))
            rows.append((number, name, *_spread(simulate(size, scenarios(size)["a rack"], seed, _WATCHED))))
    return Table("Placement and recovery", ("cameras", "on", "p50 s", "p99 s", "last s"), rows)


def check(costs: Costs, found: Mapping[str, Any]) -> Table:
    """The recoveries of the fleet of `faults.py`, simulated, beside those that it measured."""
    site = Site(cores=2, fill=0.6, rack=1, spare=0.0, pages=0)
    size = Size(6, replace(costs, state=_YOUNG_STATE), site)
    runs = [record for record in found.values() if "benchmarks/fleet/faults.py" in record["command"]]
    measured = {row[0]: row for record in runs for row in record["tables"][0]["rows"]}
    rows = []
    for name, silent in (("node killed", False), ("node frozen", True)):
        outcomes = [
            simulate(size, [NodesLost(_AT + seed / 7, range(1), _WATCHED, silent)], seed, _WATCHED)
            for seed in range(50)
        ]
        down = [seconds for outcome in outcomes for seconds in outcome.down]
        real = measured.get(name, (name, None, None, None))
        rows.append((name, *map(float, np.percentile(down, (50, 99))), real[2], real[3]))
    columns = ("fault", "p50 s, simulated", "p99 s, simulated", "p50 s, measured", "p99 s, measured")
    return Table("Three nodes and six streams on one machine", columns, rows)


def figures(options: argparse.Namespace) -> Iterator[Table]:
    found = records()
    costs, prices = Costs.read(found), Prices()
    cameras = (200, 400) if options.quick else CAMERAS
    yield assumptions(prices)
    for variant in ("as built", "both"):
        yield sizes(costs, prices, cameras, variant)
    yield head_parts(costs, cameras)
    yield recoveries(costs, cameras, options.seed)
    yield placing(costs, cameras[:2], options.seed)
    yield years(costs, cameras, Faults(), options.seed)
    if not options.quick:
        yield breaking(costs, prices, options.seed)
    yield course(costs, cameras, options.seed)
    yield check(costs, found)


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument("--seed", type=int, default=0, help="seed of the random failures (default: %(default)s)")
    options = parser.parse_args()
    publish(figures(options), options)

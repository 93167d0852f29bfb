"""The page on large fleets, `docs/scale.md`, and its plots, from the records `scale` and `fleet_costs`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from sections import DOCS, Page, Record, Section, Shown, select
from table import Cell, Table

from catstream.html.plots import SHARES, Axis, plot

__all__ = ["SCALE"]

Records = Mapping[str, Record]

_STYLE = (
    "text { font: 12px system-ui, sans-serif; fill: #222 } .title { font-size: 14px; font-weight: 600 } "
    ".grid { stroke: #8884 } @media (prefers-color-scheme: dark) { text { fill: #ddd } }"
)
_SIZES = (1000, 3000, 10_000, 30_000, 100_000)


def table(found: Records, title: str) -> Record:
    """Return a table of the record `scale` by its title."""
    return next(table for table in found["scale"]["tables"] if table["title"] == title)


def column(found: Records, title: str, name: str) -> list[Cell]:
    """Return a column of a table."""
    one = table(found, title)
    return [row[one["columns"].index(name)] for row in one["rows"]]


def cell(found: Records, title: str, row: Cell, name: str) -> float:
    """Return a figure of a table, by the first cell of its row and the name of its column."""
    return float(column(found, title, name)[[each[0] for each in table(found, title)["rows"]].index(row)] or 0)


def assumed(found: Records, name: str) -> float:
    """Return the value of an assumption."""
    return cell(found, "Assumptions", name, "value")


def cost(found: Records, name: str) -> float:
    """Return a cost that was measured."""
    return float(next(row[1] for row in found["fleet_costs"]["tables"][0]["rows"] if row[0] == name))


def limit(found: Records, variant: str) -> tuple[int, str]:
    """Return the number of cameras up to which a variant meets all limits, and the limit that ends it."""
    columns = table(found, _LIMITS)["columns"]
    number = columns.index(variant)
    rows = [row for row in table(found, _LIMITS)["rows"][:-2] if row[number] is not None]
    first = min(rows, key=lambda row: row[number])
    return first[number], first[0]


def words(number: float) -> str:
    """Format a number for a sentence.

    >>> words(18000.0), words(0.3062), words(16.1), words(5.0)
    ('18,000', '0.31', '16', '5')
    """
    return f"{number:,.0f}" if abs(number) >= 10 else f"{number:.2g}"


_LIMITS = "Cameras up to which a limit is met"
_BUILT, _BOTH = "Fleets, as built", "Fleets, both"
_RECOVERIES = "Until the streams are back"


def logarithmic(label: str, low: float, high: float, unit: str = "") -> Axis:
    """Return an axis for `log10(value / low)`, with a tick at each power of ten."""
    decades = range(round(math.log10(high / low)) + 1)
    return Axis(label, len(decades) - 1, tuple((tens, f"{low * 10**tens:,g}{unit}") for tens in decades))


def against_cameras(title: str, label: str, low: float, high: float, curves: Mapping[str, list[Cell]]) -> str:
    """Draw curves over the number of cameras; both axes are logarithmic."""
    x = Axis("cameras", 2.0, tuple((math.log10(number / 1000), f"{number:,}") for number in _SIZES))
    across = np.log10(np.array(_SIZES) / 1000)
    drawn = {
        name: (across, np.log10(np.maximum(np.array(values, float), low) / low)) for name, values in curves.items()
    }
    return picture(plot(title, x, logarithmic(label, low, high), drawn))


def picture(element: str) -> str:
    """Return the file of a plot."""
    head, rest = element.split(">", 1)
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{_STYLE}</style>{rest}\n'


def plots(found: Records) -> dict[Path, str]:
    """Draw all plots of the page."""
    parts = table(found, "Manager, share of one core")
    tasks = {name: column(found, parts["title"], name) for name in parts["columns"][1:-1]}
    lost = {row[1] for row in table(found, _RECOVERIES)["rows"]}
    last = {name: [row[5] for row in table(found, _RECOVERIES)["rows"] if row[1] == name] for name in sorted(lost)}
    course = table(found, "Share of a rack's streams that are back")
    seconds = np.array(column(found, course["title"], "s"), float)
    curves = {name: (seconds, np.array(column(found, course["title"], name), float)) for name in course["columns"][1:]}
    back = plot(course["title"], Axis.upto(seconds[-1], "seconds after the loss"), SHARES, curves)
    drawn = {
        "head": against_cameras(
            "One head: processor", "cores", 0.001, 1000, {**tasks, "one core": [1.0] * len(_SIZES)}
        ),
        "store": against_cameras(
            "States to the store",
            "GB/s",
            0.1,
            1000,
            {
                "as built": column(found, _BUILT, "GB/s"),
                "every = 30": column(found, _BOTH, "GB/s"),
                "limit of the store": [assumed(found, "store")] * len(_SIZES),
            },
        ),
        "price": against_cameras(
            "Price of a month",
            "thousand $",
            0.1,
            10_000,
            {
                f"{part}, {change}": [float(cell or 0) / 1000 for cell in column(found, title, name)]
                for part, name in (("in all", "$"), ("requests", "$ requests"))
                for change, title in (("as built", _BUILT), ("every = 30", _BOTH))
            },
        ),
        "recovery": against_cameras("Until the last stream is back", "seconds", 1, 1000, last),
        "back": picture(back),
    }
    return {DOCS / "images" / f"scale-{name}.svg": drawing for name, drawing in drawn.items()}


_HEAD = """
    This page says how far one head of a fleet goes, what breaks first beyond that, and what to do then. It is generated
    by `make results` from two records: `costs.py` measures what one machine does, and `simulate.py` computes larger
    fleets from it and simulates their failures event by event. No fleet of this size was run: the figures follow
    from the measurements and the assumptions below. Replace the assumptions by yours in `benchmarks/fleet/model.py`."""


def _far(found: Records) -> str:
    cameras, first = limit(found, "as built")
    pushed, then = limit(found, "both")
    heads, last = limit(found, "... and S3")
    state = 1000 * cell(found, _BUILT, 1000, "GB/s") / cell(found, _BUILT, 1000, "states/s")
    return f"""
        **As built, one head serves about {words(cameras)} cameras.** With more, this limit is not met: {first}. The
        manager asks each stream for its status twice a second, and an answer costs it {words(cost(found, "status"))} ms
        of processor. A larger fleet still works, because no stream needs the manager to track on; but it takes longer
        until a failure is noticed and a question is answered.

        The next limit is the store. The state of a stream that has tracked for long has {words(state)} MB, and is
        written each {words(assumed(found, "every"))} s. With `every = 30` in `fleet.toml`, it is a sixth of the load. A
        failure then costs up to 30 s of learning, and no row.

        With `every = 30`, and if streams sent their status each {words(assumed(found, "report"))} s instead of being
        asked, one head would serve {words(pushed)} cameras, up to this limit: {then}. Ten such heads and a store that
        grows with its load, such as Amazon S3, would serve {words(heads)}, up to this limit: {last}. Streams that send
        their status are not implemented: the figures show what that would be worth.

        Each column of the table changes the fleet in one way. The largest numbers of actors and machines are those of
        Ray's own scalability tests, for each head."""


def _money(found: Records) -> str:
    each, other = (cell(found, title, 100_000, "$ each") for title in (_BUILT, _BOTH))
    requests = cell(found, _BUILT, 100_000, "$ requests") / cell(found, _BUILT, 100_000, "$")
    return f"""
        ![Price of a month against the number of cameras](images/scale-price.svg)
        ![Bytes per second to the store against the number of cameras](images/scale-store.svg)

        A camera costs about {words(each)} dollars a month in a large fleet, of which {words(100 * requests)} % are
        requests to the store, and {words(other)} dollars with a state each 30 s. Machines are the rest, so the cores
        that a stream needs decide: a smaller image, or fewer frames per second, saves more than anything else here.
        Small fleets pay for the spare rack. The requests are PUT and HEAD of each state; the transfer within a region
        is free.

        Columns: states and GB that are written per second, million requests in 30 days, calls per second at the head,
        cores of its manager, dollars in 30 days, those for requests, and dollars for each camera. The first table is
        the fleet as built; in the second one, both changes are made."""


_MANAGER = """
        ![Share of one core of the manager against the number of cameras](images/scale-head.svg)

        The manager is one Python process, so it has one core. A turn is all that it does for the streams before it can
        start one: it observes, decides and answers. While a turn takes longer than half a second, everything waits for
        it. A decision costs more with more streams, and with more machines if many streams have to be placed. The
        registry collected the state of all streams for each answer when this was measured, and now answers with a state
        of at most 0.3 s ago: the third limit of the table is too low."""


_FEWER = "(3000|30000|listing_read|listing_bytes) |100000 a "  # rows that are in the record only


def _tables(record: Record, *numbers: int, without: str = "") -> Iterator[Table]:
    for number in numbers:
        yield from select(number, without=without)(record)


def _failures(found: Records) -> str:
    rows = {(row[0], row[1]): row for row in table(found, _RECOVERIES)["rows"]}
    small, large = rows[1000, "a rack"], rows[10_000, "a rack"]
    away = rows[1000, "a rack, while the store is away"]
    placing = table(found, "Placement and recovery")["rows"]
    year = table(found, "A year of failures")
    missed = dict(zip(year["columns"], year["rows"][0], strict=True))
    return f"""
        ![Share of a rack's streams that are back over time](images/scale-back.svg)
        ![Seconds until the last stream is back against the number of cameras](images/scale-recovery.svg)

        A lost rack of {words(assumed(found, "rack"))} machines takes {small[2]:,} streams with it. In a fleet of 1,000
        cameras the last of them is back after {words(small[5])} s; of 10,000 cameras, after {words(large[5])} s,
        because the turns of the manager are longer and the store is busy. Of the first seconds, up to six are Ray's
        health checks: a machine without power does not close its connections. If the store is away, no stream can
        start: the last one is back {words(away[5])} s after the loss. A stream that runs does not need the store, and
        writes its next state when the store is back.

        What a live camera loses is frames: {words(small[6])} for each stream of the rack, in the smallest fleet. A file
        loses none, because it continues from the frame of its last state. What was learned since this state is
        lost, or learned again from a file.

        Streams go to the machine with the most free cores, so all machines share the starts. If they went to the
        fullest machine with enough of them, the last stream would be back after {words(placing[1][4])} s instead of
        {words(placing[0][4])} s.

        The second table has a year of random failures. The {words(cell(found, _BUILT, 1000, "machines"))} machines of
        1,000 cameras fail {missed["machines lost"]} times, and their racks {missed["racks lost"]} times; each camera
        is not tracked for {words(missed["down s each"])} s of the year."""


_BEYOND = """
    - **First, `every = 30`.** It costs nothing but up to 30 s of learning after a failure.

    - **Fewer cores for each stream.** A lower frame rate, a smaller image or a smaller search budget: see
      [Settings](settings.md). `catstream loadtest --find-limit` measures what a machine sustains.

    - **Several heads, one for each site.** A stream needs a machine that can reach its camera, so fleets have borders
      already: give each site a `fleet.toml`, a head and a store of its own. Nothing is shared, so all figures of this
      page hold for each; a site that fails takes no other with it. To merge an object of several fleets, copy its
      saved models and use `catstream merge`.

    - **A faster store, or several.** S3 grows with its load by prefix, and each stream has a prefix of its own. For a
      store of your own, divide the streams among several fleets.

    - **KubeRay, if you run Kubernetes.** It replaces machines and pods that fail, and keeps the head's storage on a
      volume. It does not make a head larger: each RayCluster has one. See [Deploy a fleet](how-to/fleet-deploy.md).

    - **A larger head does not help**: the manager uses one core. A faster core does."""


def _measured(found: Records) -> str:
    return f"""
        Measured costs, in milliseconds of processor; the cores and the memory of a stream are those of the load test in
        [Results](results.md), its state is that of `soak.py` after a million messages, and the time to start one is
        that of `startup.py`. The machine was busy with other work. A merge of two models costs
        {words(cost(found, "merge"))} ms, so `catstream fleet merge` of 10,000 streams takes
        {words(10 * cost(found, "merge") / 60)} minutes of one core, divided among all nodes. The last block has all
        assumptions. Prices are list prices of Amazon in us-east-1."""


_REAL = """
    The same simulation, of the fleet in which `faults.py` kills and freezes nodes: three nodes and six streams on one
    machine, with young states. It counts up to the first frame, and `faults.py` up to the second one. All nodes of
    the measured fleet share two cores, which its films in lockstep use up. A dash means that it was not measured."""

SECTIONS = (
    Section("How far one head goes", _far, (Shown("scale", select(7)),)),
    Section(
        "Machines, store and price", _money, (Shown("scale", lambda record: _tables(record, 1, 2, without=_FEWER)),)
    ),
    Section("The head", _MANAGER, ()),
    Section("Failures", _failures, (Shown("scale", lambda record: _tables(record, 4, 6, without=_FEWER)),)),
    Section("What to do beyond", _BEYOND, ()),
    Section("A small fleet, simulated and measured", _REAL, (Shown("scale", select(9)),)),
    Section(
        "What was measured, and what was assumed",
        _measured,
        (
            Shown("fleet_costs", lambda record: _tables(record, 0, 1, without=_FEWER)),
            Shown("scale", select(0, without="fullest_first|pushed|heads|connection|get")),
        ),
    ),
)

SCALE = Page(DOCS / "scale.md", "How far a fleet goes", _HEAD, SECTIONS, plots)

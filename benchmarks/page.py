"""Writes the results of the documentation from the records in `benchmarks/results`: `make results`.

What is between `<!-- results: NAME -->` and `<!-- /results -->` in a page is the text that `BLOCKS[NAME]` returns. The
rest of a page, its headings and notes, is written by hand.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean
from textwrap import fill
from typing import Any

from plots import dots, lines
from sequences import CHECK, TUNED
from table import Cell

_ROOT = Path(__file__).parents[1]
IMAGES = _ROOT / "docs" / "images"
PAGES = (_ROOT / "README.md", *(_ROOT / "docs" / f"{name}.md" for name in ("results", "tutorial", "coreset-trees")))

BLOCK = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- /results -->)", re.DOTALL)
_NAMES = {"csrt": "CSRT", "kcf": "KCF", "mil": "MIL", "nano": "NanoTrackV2", "nano-v3": "NanoTrackV3"}
_ACCURACY = ("accuracy-peers", "accuracy-networks", "accuracy")
_PEERS = "Beside OpenCV's trackers"  # titles of tables in the record of speed.py
_COUNTS = ("absent", "noticed", "present", "false")  # of a sequence: see accuracy.Row
_SIZES = "Frames/s against the size of the image"


class Records(dict[str, Any]):
    """All records by name. Those that were read are noted."""

    def __init__(self) -> None:
        paths = (_ROOT / "benchmarks" / "results").glob("*.json")
        super().__init__((path.stem, json.loads(path.read_text(encoding="utf-8"))) for path in paths)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return super().__getitem__(name)

    def rows(self, name: str, table: int | str = 0) -> dict[str, dict[str, Any]]:
        """Return the rows of a table, given by its number or title, by their first cell; each cell by its column."""
        tables = self[name]["tables"]
        selected = tables[table] if isinstance(table, int) else next(one for one in tables if one["title"] == table)
        return {row[0]: dict(zip(selected["columns"], row, strict=True)) for row in selected["rows"]}

    def sequences(self, name: str, tracker: str = "catstream") -> dict[str, dict[str, Any]]:
        """Return the accuracy of a tracker on each sequence."""
        return {row["name"]: row for row in self[name]["sequences"] if row["tracker"] == tracker}

    def trackers(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return the accuracy of each tracker on each sequence, one run from the true initial box."""
        names = ((name, tracker) for name in _ACCURACY for tracker in self[name]["mean"])
        return {tracker: self.sequences(name, tracker) for name, tracker in names}


def filled(page: str, records: Records) -> str:
    """Return a page with the text of each of its blocks."""
    return BLOCK.sub(lambda block: f"{block[1]}{BLOCKS[block[2]](records)}\n{block[3]}", page)


def accuracy(records: Records) -> str:
    trackers, cost = records.trackers(), records.rows("peers")
    new = set(trackers["catstream"]) - TUNED
    whole = {name: _means(each) for name, each in trackers.items() if len(each) > len(new)}
    means = {name: _means({video: each[video] for video in new}) for name, each in trackers.items()}
    times = {name: row["times that of catstream"] for name, row in cost.items()}
    return _block(
        f"""**Of the trackers that learn from one box, without pretrained weights, it is the most accurate: AUC
        {means["catstream"][0]:.3f} on new sequences, CSRT {means["csrt"][0]:.3f} at
        {times["csrt"]:.1f} times the processor time.** NanoTrackV3, a network trained on many videos, has
        {means["nano-v3"][0]:.3f} at {times["nano-v3"]:.1f} times the time.""",
        ("tracker", "learned from", f"AUC, {len(new)} new", "success", "AUC, all", "success", "processor time"),
        [
            (
                _NAMES.get(name, name),
                "videos" if name.startswith("nano") else "one box",
                *means[name],
                *whole.get(name, (None, None)),
                times[name],
            )
            for name in sorted(trackers, key=lambda name: -means[name][0])
        ],
    )


def sequences(records: Records) -> str:
    trackers = records.trackers()
    auc = {name: (row["auc"], trackers["csrt"][name]["auc"]) for name, row in trackers["catstream"].items()}
    ranked = dict(sorted(auc.items(), key=lambda item: -item[1][0]))
    rows = {name if name in TUNED else f"{name} *": values for name, values in ranked.items()}
    plot = dots("Accuracy on each sequence", "area under the success plot (AUC)", rows, ("catstream", "CSRT"))
    (IMAGES / "sequences.svg").write_text(plot, encoding="utf-8")
    low = [name for name, (ours, _) in ranked.items() if ours < 0.4]
    return _paragraph(f"""
        **The AUC is below 0.4 on {len(low)} of {len(auc)} sequences: {", ".join(low)}.** CSRT is better than catstream
        on {sum(ours < csrt for ours, csrt in auc.values())}.""")


def boxes(records: Records) -> str:
    one, four = records.sequences("accuracy"), records.sequences("accuracy-jitter")
    groups = {
        "all": set(one),
        "the 20 on which the defaults were chosen": TUNED,
        "the other 24": set(one) - TUNED,
        "of these, the 12 that were not used for any choice": CHECK - TUNED,
    }
    rows = [
        (group, *(mean for each in (one, four) for mean in _means({name: each[name] for name in names})))
        for group, names in groups.items()
    ]
    return _block(
        f"""**Little on average: over four boxes that differ by at most 2 %, the AUC is {rows[0][3]:.3f} in place of
        {rows[0][1]:.3f}.** On new sequences, expect
        {rows[2][3]:.2f} to {rows[2][1]:.2f}.""",
        ("sequences", "AUC, true box", "success", "AUC, mean of four boxes", "success"),
        rows,
    )


def absence(records: Records) -> str:
    rows = [
        (name, absent, f"{noticed:,} ({noticed / absent:.0%})", present, f"{false:,} ({false / present:.1%})")
        for name, absent, noticed, present, false in _absence(records)
    ]
    heads = ("sequence, four runs", "frames without it", "absence noticed", "frames with it", "falsely absent")
    return _block(f"**Not always: {_noticed(records)}**", heads, rows)


def speed(records: Records) -> str:
    rates, sizes = records.rows("speed", _PEERS), records.rows("speed", _SIZES)
    three, one = rates["catstream, three processes"], rates["catstream, one core"]
    rows: list[Sequence[Cell]] = [
        ("`catstream track`, three processes, with decoding", three["first 150 frames"], three["the rest"]),
        ("`Tracker`, one core", one["first 150 frames"], one["the rest"]),
        *((f"`catstream track`, {size} pixels", None, sizes[size]["local"]) for size in _SHOWN_SIZES),
    ]
    return _block(
        f"""**{three["the rest"]:.0f} frames/s with `catstream track` on {records["speed"]["machine"]["cores"]} cores,
        {one["the rest"]:.0f} with a `Tracker` on one; at 1920x1080 pixels
        {sizes["1920x1080"]["local"]:.0f}.**""",
        ("frames/s", "first 150 frames", "the rest"),
        rows,
    )


_SHOWN_SIZES = ("640x480", "1920x1080", "3840x2160")


def startup(records: Records) -> str:
    times = {kernels: row["first track, s"] for kernels, row in records.rows("startup").items()}
    return _paragraph(
        f"""**The first track arrives in {times["warm"]:.1f} s; the first time, when kernels are compiled, in
        {times["cold"]:.0f} s** (medians of three)."""
    )


def long(records: Records) -> str:
    curves = {}
    for name in ("long_videos", "long_videos-50000"):
        for label, row in records.rows(name).items():
            video = label.removesuffix(", n = 64").removeprefix("TLD_")
            if video not in curves and not (label.startswith("paper") and label != "paper: CAT, n = 2500"):
                frames = [column for column in row if column != "frames"]
                curves[video] = [(int(frame), row[frame]) for frame in frames]
    ticks, shares = range(0, 100_001, 20_000), [tick / 5 for tick in range(6)]
    curves["paper: CAT, n = 2500"] = curves.pop("paper: CAT, n = 2500")  # it is the last one
    plot = lines("Success up to a frame of a long video", ("frame", ticks), ("success", shares), curves)
    (IMAGES / "long_videos.svg").write_text(plot, encoding="utf-8")
    growth = records.rows("long_videos-50000", 1)
    ratios, memory = ([row[column] for row in growth.values()] for column in ("ratio", "MB at the end"))
    return _block(
        f"""**Yes, except where it loses the object (panda): the processor time of a frame in the last tenth of 50,000
        frames is {min(ratios):.2f} to {max(ratios):.2f} of that in the first tenth, the memory of all processes at most
        {max(memory):.0f} MB.**""",
        ("50,000 frames of", "ms a frame, first tenth", "last tenth", "MB, first tenth", "at the end"),
        [
            [name.removesuffix(", n = 64"), *list(row.values())[1:3], *list(row.values())[4:]]
            for name, row in growth.items()
        ],
    )


def paper(records: Records) -> str:
    theirs, ours = records.rows("root_or_hierarchy"), records.rows("root_or_hierarchy-ours")
    samples, our_samples, tld = records.rows("sampling"), records.rows("sampling-ours"), records.rows("tld")

    def trees(source: str) -> Sequence[Cell]:
        way = theirs[f"paper's way, {source}"]
        return way["paper: success"], way["success"], ours[f"our settings, {source}"]["success"]

    def sampled(kind: str) -> Sequence[Cell]:
        rows = samples[f"{kind}, paper, n = 512"], samples[kind], our_samples[kind]
        return [f"{min(values):.3f} to {max(values):.3f}" for _, *values in (row.values() for row in rows)]

    defaults = records.rows("tld-defaults")["defaults"]["mean"]
    rows: list[Sequence[Cell]] = [
        ("on TLD", tld["cat25"]["paper: mean of ten"], tld["cat25"]["mean"], defaults),
        ("trained on all nodes of the tree", *trees("hierarchy")),
        ("trained on its root", *trees("root")),
        ("trained on a coreset", *sampled("coreset")),
        ("trained on a random sample of the same size", *sampled("random")),
    ]
    return _block(
        """**Two are not.** Training on all nodes of the tree is better than on its root with the defaults, but not with
        the paper's settings. A coreset is better than a random sample with the paper's settings, but not with the
        defaults.""",
        ("success", "printed in the paper", "the paper's settings", "the defaults"),
        rows,
    )


def training(records: Records) -> str:
    columns = ("points", "all points, ms", "coreset, n = 64, ms")
    rows = [[row[column] for column in columns] for row in records.rows("time_complexity").values()]
    points, everything, coreset = zip(*rows, strict=True)
    rows = [rows[0], rows[len(rows) // 2], rows[-1]]
    return _block(
        f"""**Yes: from {points[0]} to {points[-1]:,} points, one training on a coreset takes {min(coreset):.1f} to
        {max(coreset):.1f} ms, on all points {everything[0]:.0f} to {everything[-1]:,.0f} ms.**""",
        columns,
        rows,
    )


def load(records: Records) -> str:
    """The largest number of streams that `catstream loadtest --find streams` has found."""
    record = records["loadtest"]
    plan, track, model = record["plan"], record["latency"]["track"], record["latency"]["model"]
    cores, size = sum(stream["cores"] for stream in record["streams"]), "x".join(map(str, plan["size"]))
    return _paragraph(
        f"""**{record["highest"]} of {size} pixels at {plan["rate"]:.0f} frames/s over H.264, with {cores:.1f} of
        {record["machine"]["cores"]} cores.** The track of a frame arrives after {1000 * track["p50"]:.0f} ms (median;
        99 % {1000 * track["p99"]:.0f} ms), the model trained on it or on a newer frame after
        {model["p50"]:.1f} s (99 % {model["p99"]:.1f} s). `catstream loadtest` measures other loads."""
    )


def faults(records: Records) -> str:
    recovery = [row for row in records["chaos"]["tables"][0]["rows"] if row[1] == "all"]
    rows: list[Sequence[Cell]] = []
    for (run, row), (_, _, _, median, _, slowest) in zip(records.rows("chaos", 1).items(), recovery, strict=True):
        lost = row["sent"] - row["stored"]
        rows.append((f"{row['faults']} faults, {run}", lost, median, slowest, row["without"], row["success"]))
    (killed,) = records.rows("resume").values()
    longest = killed["longest"]
    name = f"all processes killed, {killed['killed']} times"
    rows.append((name, killed["rows lost"], killed["s to a new row"], longest, None, None))
    return _block(
        f"""**No row is lost, and the run continues within {max(row[5] for row in recovery):.1f} s, or within
        {longest:.1f} s after all processes were killed.** Faults are kill -9, SIGSTOP, a full disk and a clock that
        jumps.""",
        ("run", "lost", "s to recover, median", "slowest", "success without faults", "with"),
        rows,
    )


def fleet(records: Records) -> str:
    rows, noticed = records.rows("fleet_faults"), records.rows("fleet_faults", 1)
    (films,) = records.rows("fleet_faults", 2).values()
    return _block(
        f"""**In {rows["all"]["p50 s"]:.0f} s (median), at most {rows["all"]["slowest s"]:.0f} s; no row was lost or
        doubled, and the trees of {films["trees the same"]} videos are those without faults, bit for bit.** Most of the
        time passes until Ray notices the fault.""",
        ("fault", "times", "s to recover, median", "slowest", "after Ray noticed"),
        [
            (name, row["times"], row["p50 s"], row["slowest s"], noticed[name]["p50 s"])
            for name, row in rows.items()
            if name in noticed
        ],
    )


def found(records: Records) -> str:
    real, rendered = records.rows("instance"), records.rows("instance", 2)
    recall = "recall at 1 false alarm in 100"
    return _block(
        f"""**Mostly: in {real["catstream"][recall]:.0%} of the frames with the object, at one false alarm in 100
        frames.** Template matching and ORB know the first frame only, as does the second row.""",
        ("method", "mean AP, public sequences", recall, "AP, rendered, as in the paper"),
        [(name, row["mean AP"], row[recall], rendered[name]["AP"]) for name, row in real.items()],
    )


def annotation(records: Records) -> str:
    measured, complete = records["keyframes"]["rows"], records["keyframes"]["complete"]
    frames = records.sequences("accuracy")
    rows: list[Sequence[Cell]] = []
    for group, names in (("the check list", complete.keys() & CHECK), ("the others", complete.keys() - CHECK)):
        for boxes in (2, 4, 8):
            each = [row for row in measured if row["name"] in names and row["boxes"] == boxes]
            checked = {row["name"]: row["checked"] * frames[row["name"]]["frames"] - boxes for row in each}
            precise = {row["name"]: row["precision"] for row in each if row["precision"] is not None}
            right = sum(checked[name] * share for name, share in precise.items())
            pooled = right / sum(checked[name] for name in precise)
            others = (fmean(row[share] for row in each) for share in ("interpolation", "forward"))
            share = fmean(row["checked"] for row in each)
            success = fmean(row["success"] for row in each)
            rows.append((f"{len(names)} of {group}", boxes, success, share, pooled, *others))
    done = {boxes: sum((count or 9) <= boxes for count in complete.values()) for boxes in (2, 4, 8)}
    until = fmean(count for count in complete.values() if count)
    return _block(
        f"""**Two are enough for {done[2]} of {len(complete)} sequences, four for {done[4]}, eight for {done[8]},
        which need {until:.1f} on average:** then at least 95 % of the frames are right, and expected to be.""",
        ("sequences", "boxes", "success", "checked", "of these, right", "interpolation", "forwards only"),
        rows,
    )


def hostile(records: Records) -> str:
    rows = records.rows("fuzz").values()
    inputs, crashes, hangs = (sum(row[column] for row in rows) for column in ("inputs", "crashes", "hangs"))
    answer = f"""**No: {len(rows)} decoders of messages and files had {inputs:,} hostile inputs, with {crashes} crashes,
        {hangs} hangs and at most {max(row["MB more"] for row in rows):.0f} MB more memory.**"""
    return _paragraph(answer)


def stream(records: Records) -> str:
    cells: dict[str, list[Cell]] = {}
    table = records["sketch"]["tables"][0]["rows"]
    for name, _, _, excess, seconds, memory in table:
        share = max(float(excess), 0.0)
        error = f"+{share:.1%}" if share > 1e-3 else f"{share:.0e}" if share > 1e-8 else "0"
        cells.setdefault(name, []).append(f"{error}, {seconds:.1f} s, {memory:.0f} MB")
    heads = ("", *dict.fromkeys(f"d = {d:,}, {rows:,} rows" for _, d, rows, *_ in table))
    return _block("", heads, [(name, *row) for name, row in cells.items()])


def summary(records: Records) -> str:
    trackers = records.trackers()
    new = set(trackers["catstream"]) - TUNED
    auc = {name: _means(each)[0] for name, each in trackers.items()}
    on_new = {name: _means({video: each[video] for video in new})[0] for name, each in trackers.items()}
    rates = {name: row["the rest"] for name, row in records.rows("speed", _PEERS).items()}
    return _paragraph(f"""
        **AUC {auc["catstream"]:.3f} on {len(records.sequences("accuracy"))} public sequences** (area under the success
        plot; OpenCV's CSRT {auc["csrt"]:.3f}). On the {len(new)} that were not used to choose the defaults it reaches
        {on_new["catstream"]:.3f}, CSRT {on_new["csrt"]:.3f}, and NanoTrackV3, a network of 2022 that was trained on
        many videos, {on_new["nano-v3"]:.3f}. **{rates["catstream, three processes"]:.0f} frames/s** on
        {records["speed"]["machine"]["cores"]} cores with decoding, at about 320x240 pixels;
        {rates["catstream, one core"]:.0f} on one core without decoding (CSRT {rates["csrt, one core"]:.0f}). See
        [Results](docs/results.md).""")


def limits(records: Records) -> str:
    return _paragraph(f"""
        - It does not always report that the object is absent. In the rendered video of `catstream demo` it does in
        each of 108 frames; in four runs of each real video, {_noticed(records)}""")


def choice(records: Records) -> str:
    rates = {name: row["the rest"] for name, row in records.rows("speed", _PEERS).items()}
    return _paragraph(f"""
        On {records["speed"]["machine"]["cores"]} cores, three processes track
        {rates["catstream, three processes"]:.0f} frames/s, and a `Tracker` {rates["catstream, one core"]:.0f}. The
        first track of `catstream track` arrives {records.rows("startup")["warm"]["first track, s"]:.1f} s after the
        command.""")


def _means(rows: dict[str, dict[str, Any]]) -> tuple[float, float]:
    """Return the mean AUC and success."""
    return fmean(row["auc"] for row in rows.values()), fmean(row["success"] for row in rows.values())


def _absence(records: Records) -> list[tuple[Any, ...]]:
    """Return the counts of frames of each sequence with absence, and of all sequences."""
    rows = records.sequences("accuracy-jitter")
    total = (sum(row[count] for row in rows.values()) for count in _COUNTS)
    return [
        *((name, *(row[count] for count in _COUNTS)) for name, row in rows.items() if row["absent"]),
        (f"all {len(rows)}", *total),
    ]


def _noticed(records: Records) -> str:
    *_, (_, absent, noticed, present, false) = _absence(records)
    return (
        f"absence is reported in {noticed} of the {absent:,} frames without the object ({noticed / absent:.0%}), and "
        f"falsely in {false:,} of the {present:,} frames with it ({false / present:.1%})."
    )


def _block(answer: str, heads: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """Return an answer and a table."""
    cells = zip(*map(_column, zip(*rows, strict=True)), strict=True)
    lines = (heads, ["---", *["---:"] * (len(heads) - 1)], *cells)
    table = "\n".join(f"| {' | '.join(line)} |".replace("|  |", "| |") for line in lines)
    return f"{_paragraph(answer)}\n\n{table}" if answer else table


def _column(cells: Sequence[Cell]) -> Sequence[str]:
    """Return the cells of a column as text; floats have three digits, of which as many are decimals in all rows."""
    most = max((abs(cell) for cell in cells if isinstance(cell, float)), default=0.0)
    decimals = 0 if most >= 100 else 1 if most >= 10 else 2 if most > 1 else 3
    forms = {float: f"{{:.{decimals}f}}", int: "{:,}", str: "{}"}
    return ["" if cell is None else forms[type(cell)].format(cell) for cell in cells]


def _paragraph(text: str) -> str:
    """Return a paragraph in lines of at most 120 characters."""
    text = " ".join(text.split())
    indent = "  " if text.startswith("- ") else ""
    return fill(text, 120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


#: Functions that return the text of a block, by its name.
BLOCKS: dict[str, Callable[[Records], str]] = {
    block.__name__: block
    for block in (
        *(accuracy, sequences, boxes, absence, annotation, speed, startup, long, paper, training, load, faults),
        *(fleet, found, hostile, stream, summary, limits, choice),
    )
}


if __name__ == "__main__":
    all_records = Records()
    for path in PAGES:
        path.write_text(filled(path.read_text(encoding="utf-8"), all_records), encoding="utf-8")

"""Writes the pages of `PAGES` from the records in `benchmarks/results`: `make results`.

The pages have nothing that is not in a record but the headings and the few sentences below. The figures of README and
of the tutorial come from the same records.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from textwrap import fill
from typing import NamedTuple

from accuracy_tables import Record, absence, by_sequence, extremes, groups
from table import Table, text

_NOTES = Path(__file__).parent
DOCS = _NOTES.parent / "docs"
_README = _NOTES.parent / "README.md"
_MARKS = re.compile(r"(<!-- results: .*? -->\n).*?(<!-- /results -->)", re.DOTALL)


class Shown(NamedTuple):
    """A record on the page: its file in `benchmarks/results`, the tables made from it, and what they measure."""

    record: str
    tables: Callable[[Record], Iterable[Table]]
    measure: str = ""


class Section(NamedTuple):
    """A part of the page: its heading, an introduction to its tables, and the tables."""

    heading: str
    introduction: str | Callable[[Mapping[str, Record]], str]
    parts: tuple[Shown, ...]


class Page(NamedTuple):
    """A page of results: its file, its title, an introduction, and the sections."""

    path: Path
    title: str
    introduction: str
    sections: tuple[Section, ...]


def records() -> dict[str, Record]:
    """Return all records by name."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted((_NOTES / "results").glob("*.json"))
    }


def written(page: Page, found: Mapping[str, Record]) -> str:
    """Return the text of a page."""
    parts = [f"# {page.title}", filled(page.introduction)]
    for section in page.sections:
        blocks = [_block(found[shown.record], shown) for shown in section.parts]
        introduction = section.introduction if isinstance(section.introduction, str) else section.introduction(found)
        parts += [f"## {section.heading}", filled(introduction)]
        parts += ["```console\n" + "\n".join(blocks) + "\n```"] if blocks else []
    return "\n\n".join(parts) + "\n"


def _block(record: Record, shown: Shown) -> str:
    machine, settings = record["machine"], record["settings"]
    made = [record["date"], f"commit {record['commit']}", f"{machine['cores']} cores of {machine['processor']}"]
    made += [f"{len(settings)} settings differ from the defaults"] if len(settings) > 2 else settings
    measure = f"# {shown.measure}\n" if shown.measure else ""
    return f"$ {record['command']}  # {', '.join(made)}\n{measure}" + "\n\n".join(map(text, shown.tables(record)))


def select(number: int = 0, *, columns: Sequence[str] = (), without: str = "") -> Callable[[Record], Iterator[Table]]:
    """Return a function that selects table `number` of a record, with these columns, without the rows of a pattern."""

    def chosen(record: Record) -> Iterator[Table]:
        table = record["tables"][number]
        every_place = range(len(table["columns"]))  # two columns may have one name
        places = [table["columns"].index(column) for column in columns] or every_place
        kept = [row for row in table["rows"] if not (without and re.match(without, " ".join(map(str, row))))]
        yield Table(
            "", [table["columns"][place] for place in places], [[row[place] for place in places] for row in kept]
        )

    return chosen


def several(*parts: Callable[[Record], Iterable[Table]]) -> Callable[[Record], Iterator[Table]]:
    """Return a function that makes the tables of several functions."""
    return lambda record: (table for part in parts for table in part(record))


def filled(paragraphs: str) -> str:
    """Return paragraphs, which blank lines separate, in lines of at most 120 characters."""
    return "\n\n".join(
        fill(
            " ".join(paragraph.split()),
            120,
            subsequent_indent="  " if paragraph.lstrip().startswith("- ") else "",
            break_long_words=False,
            break_on_hyphens=False,
        )
        for paragraph in re.split(r"\n\s*\n", paragraphs.strip())
    )


def shown() -> set[str]:
    """Return the names of the records on the pages."""
    return {part.record for page in PAGES for section in page.sections for part in section.parts}


def with_figures(path: Path, found: Mapping[str, Record]) -> str:
    """Return a page of `MARKED` with the figures between its marks."""
    page, figures = path.read_text(encoding="utf-8"), iter(MARKED[path])
    return _MARKS.sub(lambda marks: f"{marks[1]}{next(figures)(found)}\n{marks[2]}", page)


def faults(record: Record) -> Iterator[Table]:
    """Summarise the chaos record over all kinds of faults."""
    recovered = {row[0]: row[3:] for row in record["tables"][0]["rows"] if row[1] == "all"}
    heads, rows = record["tables"][1]["columns"], record["tables"][1]["rows"]
    joined = [(*row, recovered[row[0]][0], recovered[row[0]][-1]) for row in rows]
    yield Table("", [*heads, "p50 s", "slowest s"], joined)


def totals(record: Record) -> Iterator[Table]:
    """Summarise the fuzzing record over all decoders."""
    (table,) = select()(record)
    inputs, accepted, rejected, _, memory, crashes, hangs = list(zip(*table.rows, strict=True))[1:]
    heads = ("decoders", "inputs", "accepted", "rejected", "most MB more", "crashes", "hangs")
    yield Table(
        "", heads, [(len(table.rows), *map(sum, (inputs, accepted, rejected)), max(memory), sum(crashes), sum(hangs))]
    )


def beside_others(record: Record) -> Iterator[Table]:
    """Select the speed beside other trackers, and by the size of the image."""
    yield from _titled(record, {_PEERS: "", _SIZES: "320|960|1280"})


def speeds(record: Record) -> Iterator[Table]:
    """Select the speed in a user's program, the time of the slowest frames, and that of each stage."""
    yield from _titled(record, dict.fromkeys(("Tracker in a user's program", "Time of a frame", _STAGES), ""))


def _titled(record: Record, titles: Mapping[str, str]) -> Iterator[Table]:
    """Select tables by their titles, each without the rows of a pattern."""
    for number, table in enumerate(record["tables"]):
        if table["title"] in titles:
            yield from select(number, without=titles[table["title"]])(record)


def robustness(record: Record) -> Iterator[Table]:
    """Select the means of all trackers and starts, the AUC of each tracker by attribute, and the losses."""
    yield from select(0)(record)
    columns = record["tables"][1]["columns"]
    yield from select(1, columns=[*columns[:6], *(column for column in columns[6:] if column.endswith(" AUC"))])(record)
    yield from select(2)(record)


def load(record: Record) -> Iterator[Table]:
    """Summarise a load test over all its streams."""
    streams, track, model = record["streams"], record["latency"]["track"], record["latency"]["model"]
    skipped = sum(stream["skipped"] for stream in streams) / sum(stream["frames"] for stream in streams)
    times = ("track p50, ms", "p99, ms", "model p50, ms")
    heads = ("streams", "frames/s due", "frames/s of each", "skipped", *times, "success")
    rate = fmean(stream["frames_per_second"] for stream in streams)
    success = fmean(stream["success"] for stream in streams)
    milliseconds = [1000 * seconds for seconds in (track["p50"], track["p99"], model["p50"])]
    yield Table("", heads, [(len(streams), record["plan"]["rate"], rate, skipped, *milliseconds, success)])


def _accuracy(found: Mapping[str, Record]) -> str:
    peers = found["accuracy-peers"]
    leaves = sum(row["f_score"] is not None for row in peers["sequences"] if row["tracker"] == "catstream")
    scores = ", ".join(f"{tracker} {mean['f_score']:.3f}" for tracker, mean in peers["mean"].items())
    return f"""
        **The defaults were chosen on the first 20 of these sequences**, so the accuracy on a new video is lower. The
        fifteen of the check list are not used to choose anything. The other trackers are from OpenCV
        {peers["machine"]["opencv"]}. F-score over the {leaves} sequences in which the object disappears, in the runs
        with other trackers: {scores}.

        **Absence is not always noticed**: over four initial boxes of each sequence,
        {_noticed(found["accuracy-jitter"])} A single run depends on chance: see panda."""


def _noticed(record: Record) -> str:
    (table,) = absence(record)
    *each, (_, absent, noticed, share, present, false, wrong) = table.rows
    names = ", ".join(f"{name} {part:.0%}" for name, _, _, part, *_ in each)
    return (
        f"absence is reported in {noticed} of the {absent} frames without the object ({share:.0%}; {names}), and "
        f"falsely in {false} of the {present} frames with it ({wrong:.1%})."
    )


def _absence(found: Mapping[str, Record]) -> str:
    return filled(f"""
        - It does not always report that the object is absent. In the rendered video of `catstream demo` it does in
        each of 108 frames; in four runs of each real video, {_noticed(found["accuracy-jitter"])}""")


def _paper(found: Mapping[str, Record]) -> str:
    tables = [table for name in ("root_or_hierarchy", "root_or_hierarchy-ours") for table in found[name]["tables"]]
    trees = {row[0]: dict(zip(table["columns"], row, strict=True)) for table in tables for row in table["rows"]}

    def trained(way: str, measure: str = "success") -> str:
        whole, root = (trees[f"{way}, {source}"][measure] for source in ("hierarchy", "root"))
        return f"{whole:.3f} against {root:.3f}"

    def span(name: str, kind: str) -> str:
        values = next(row[1:] for row in found[name]["tables"][0]["rows"] if row[0] == kind)
        return f"{min(values):.3f} to {max(values):.3f}"

    rows = (row for row in found["accuracy"]["sequences"] if row["tracker"] == "catstream")
    panda = next(row for row in rows if row["name"] == "TLD_10_panda")
    return f"""
        `cat25` and `cat10` are the tracker of the paper, implemented from its text. The columns and rows "paper" are
        its printed figures, on other videos. The defaults were chosen on most of these sequences. Panda depends on
        chance: the success of one pass is {panda["success"]:.3f}. [A plot](images/long_videos.png) shows time and
        memory over a long video.

        **Two claims of the paper are not confirmed.** The first is that training on a sample of all nodes of the tree
        is better than training on its root: success {trained("our settings", "paper: success")} in the paper. With our
        settings it is better ({trained("our settings")}), with the paper's own settings it is not
        ({trained("paper's way")}). The second is that a coreset is better than a random sample of the same size:
        {span("sampling", "coreset, paper, n = 512")} against {span("sampling", "random, paper, n = 512")} in the
        paper, by the share of training frames. With the paper's settings it is better
        ({span("sampling", "coreset")} against {span("sampling", "random")}), with ours it is not
        ({span("sampling-ours", "coreset")} against {span("sampling-ours", "random")}). All are single runs:
        `benchmarks/details.md` has the tables."""


def _rates(speed: Record) -> dict[str, list[float]]:
    """Frames per second at the start and afterwards, of each tracker."""
    return {row[0]: row[1:3] for table in speed["tables"] if table["title"] == _PEERS for row in table["rows"]}


def _figures(found: Mapping[str, Record]) -> str:
    speed, rates = found["speed"], _rates(found["speed"])
    boxes, ours, theirs = (
        found[name]["mean"][tracker]["auc"]
        for name, tracker in (("accuracy-jitter", "catstream"), ("accuracy", "catstream"), ("accuracy-peers", "csrt"))
    )
    (start, rest), (one_start, one_rest) = rates["catstream, three processes"], rates["catstream, one core"]
    csrt, threaded = rates["csrt, one core"][1], rates["csrt, all cores"][1]
    return filled(f"""
        On {len(found["accuracy"]["sequences"])} public sequences, the area under the success plot (AUC) is
        **{boxes:.3f}** on average over four initial boxes that differ by at most 2 %, and {ours:.3f} from the true
        initial box (OpenCV's CSRT: {theirs:.3f}). The defaults were chosen on 20 of the sequences;
        [Results](docs/results.md) lists the others separately.

        On {speed["machine"]["cores"]} cores, `catstream track` processes **{rest:.0f} frames/s** ({start:.0f} in the
        first 150 frames), including the decoding; `catstream.Tracker` in one process
        {one_rest:.0f} ({one_start:.0f}). CSRT processes {csrt:.0f} frames/s on one core and {threaded:.0f} on
        {speed["machine"]["cores"]} (`{speed["command"]}`).""")


def _choice(found: Mapping[str, Record]) -> str:
    rates = _rates(found["speed"])
    three, one = rates["catstream, three processes"][1], rates["catstream, one core"][1]
    (start,) = (row for table in found["startup"]["tables"] for row in table["rows"] if row[0] == "warm")
    return filled(f"""
        On {found["speed"]["machine"]["cores"]} cores, three processes track {three:.0f} frames/s, and a `Tracker`
        {one:.0f}. The first track of `catstream track` arrives {start[2]:.1f} s after the command.""")


_HEAD = """
    Written by `make results` from the records in `benchmarks/results`. The comment after a command is the date, the
    commit and the machine of the table below it, and the settings that differ from today's defaults: until 26 November,
    `belief.weak_score` was 0.3, and until 27 November, `training.interval` was 1. The next line is the measure and the
    number of runs. [Evaluate on your own video](how-to/evaluate.md) defines the measures. The folder `benchmarks` has
    more tables, and describes each measurement in its `README.md`."""
_DETAILS_HEAD = """
    The tables that [Results](../docs/results.md) leaves out or shortens, also written by `make results` from the
    records in `benchmarks/results`. [Benchmarks](README.md) describes each measurement."""
_MORE_HEAD = """
    A fleet under faults, objects that are detected in other videos, and PCA of a stream of rows, written by `make
    results` from the records in `benchmarks/results`."""
_ROBUSTNESS = """
    How much the accuracy depends on the start and on the initial box. Written by `make results` from the records in
    `benchmarks/results`."""
_STARTS = """
    OPE is one run of each sequence; TRE starts it from several frames; jitter changes the initial box by at most 2 %,
    and SRE, of which the first 120 frames are tracked, by 10 to 20 %. Each sequence counts once, with the mean over its
    runs; ± is the standard error over the sequences. F is that of the sequences in which the object is absent in some
    frames. A sequence flips if its success differs by more than 0.25 between the jittered boxes. A run is lost if fewer
    than half of the frames in its last quarter have an overlap above 0.5. The check sequences are not used to choose
    anything. The table of attributes has the runs of OPE; [Evaluate on your own
    video](../docs/how-to/evaluate.md#5-compare) defines them."""
_FLEET = """
    Six streams on three nodes of one machine with two cores, and a real S3 server as the store. First, three are live,
    and three are short films, as fast as the cores allow, whose trees are compared, bit for bit, with those without
    faults; `wrong` counts other trees, streams that stood still or were started again when they should not, and what
    did not happen in three minutes. Then all are live and slow, so that a core is
    free. The second and the last table begin when Ray has noticed the fault. See [the
    how-to](../docs/how-to/fleet.md)."""
_FOUND = """
    Every fourth object is learned from the first third of its sequence, and searched in frames of the rest and of all
    other sequences. A sighting is right if it overlaps the object by half; the average precision counts all others as
    wrong, and a false alarm is a sighting in a frame without the object. The second table has the objects of the check
    list. Template matching and ORB know the first frame. In the paper's setting, a
    rendered object is learned in 76 frames before a plain background, and searched before other backgrounds, turned,
    scaled and in other lights. The machine was busy: only the ratios of times count. See [the
    how-to](../docs/how-to/find.md)."""
_STREAMS = """
    Excess is the squared reconstruction error of all rows, divided by that of a PCA of all rows, less 1. The machine
    was busy, so processor seconds are shown, of BLAS with one thread; MB are added by the fit. In the second table,
    `limited` sets OPENBLAS_NUM_THREADS=1, and `default` no variable. See [Coreset trees](../docs/coreset-trees.md)."""
_SPEED = """
    Each tracker has one core, without decoding; only the three processes decode, and use all cores. A frame of a long
    run takes as long as one at its beginning."""
_LOAD = """
    The load tests use videos of 640x480 pixels at 25 frames/s; the latency is measured from the due time of a frame.
    Faults (kill -9, SIGSTOP, a full disk) are measured in seconds until recovery. The last table is of runs
    that were killed with all their processes, and resumed."""
_SEQUENCES = """
    One run from the initial box of each sequence. * is the check list; the defaults were chosen on the first 20."""
_PAPER_DETAILS = """
    These experiments use the first 20 sequences, or the five TLD videos among them. "The paper's way" is the tracker of
    the paper, implemented from its text; the rows with the name of the paper are its printed figures, on other videos.
    Plots: [long videos](../docs/images/long_videos.png), [time of one training](../docs/images/time_complexity.png)."""
_SPEED_DETAILS = """
    `Tracker` in a program of a user, the time of a frame in one process and in three, and that of each stage. The three
    processes and `subscribers.py` decode the video, the others do not."""
_PEERS = "Beside OpenCV's trackers"
_STAGES = "Milliseconds a frame, on one core"
_THREE = several(*map(select, range(3)))
_SIZES = "Frames/s against the size of the image"

SECTIONS = (
    Section(
        "Accuracy",
        _accuracy,
        (
            Shown(
                "accuracy",
                several(groups, extremes, absence),
                "AUC and success of one run of each sequence: means, worst and best; frames without a reported box",
            ),
            Shown(
                "accuracy-jitter",
                several(groups, extremes, absence),
                "the same, means of four runs of each sequence, from initial boxes that differ by at most 2 %",
            ),
            Shown("accuracy-peers", groups, "AUC and success beside other trackers, means of one run of each sequence"),
        ),
    ),
    Section(
        "Beside the paper",
        _paper,
        (
            Shown("tld-defaults", select(without="(?!defaults)"), "success, mean of four initial boxes of each video"),
            Shown("tld", select(without="(?!cat)"), "success of one run of each video"),
            Shown("root_or_hierarchy-ours", select(), "means of one run of each of the first 20 sequences"),
            Shown(
                "long_videos",
                select(without="paper: (CAT, n = (5|10|15|20)00|TLD|TGPR) "),
                "success up to a frame, one run of the best video",
            ),
            Shown("long_videos-50000", select(), "the same, one run of each of four videos; the worst is panda"),
            Shown("time_complexity", select(without="512|1024|2048|4096"), "time of one training"),
        ),
    ),
    Section(
        "Speed",
        _SPEED,
        (
            Shown(
                "speed",
                beside_others,
                "frames/s of one run over the frames of four sequences, and of a rendered video by its size",
            ),
            Shown("startup", select(), "seconds, medians of three runs"),
            Shown("long_videos-50000", select(1), "processor time and memory of one run of each video"),
        ),
    ),
    Section(
        "Load and faults",
        _LOAD,
        (
            Shown("loadtest", load, "one run: latency over all frames; success: mean of the streams"),
            Shown("chaos", faults, "success of one run of each kind, and seconds to recover over all faults"),
            Shown("resume", select(), "one run, killed at each moment; seconds: median, longest"),
        ),
    ),
)

DETAILS = (
    Section("Accuracy on each sequence", _SEQUENCES, (Shown("accuracy-peers", by_sequence),)),
    Section(
        "The paper's experiments",
        _PAPER_DETAILS,
        (
            Shown("root_or_hierarchy", select()),
            Shown("sampling", select(without=".*paper")),
            Shown("sampling-ours", select(without=".*paper")),
            Shown("coreset_size", select(without="2.5 %|10 %")),
            Shown("bootstrap", select()),
        ),
    ),
    Section("Speed", _SPEED_DETAILS, (Shown("speed", speeds), Shown("subscribers", select(without="0 ")))),
    Section("Hostile input", "Inputs of all decoders of messages and files.", (Shown("fuzz", totals),)),
)

MORE = (
    Section("A fleet under faults", _FLEET, (Shown("fleet_faults", _THREE), Shown("fleet_faults-free", select(1)))),
    Section("Objects found again", _FOUND, (Shown("instance", _THREE),)),
    Section("PCA of a stream", _STREAMS, (Shown("sketch", several(select(0), select(1))),)),
)

ROBUSTNESS = (
    Section("Starts and initial boxes", _STARTS, (Shown("robustness", robustness), Shown("shifts", select(0)))),
)

PAGES = (
    Page(DOCS / "results.md", "Results", _HEAD, SECTIONS),
    Page(_NOTES / "details.md", "Details of the results", _DETAILS_HEAD, DETAILS),
    Page(_NOTES / "robustness.md", "Robustness", _ROBUSTNESS, ROBUSTNESS),
    Page(_NOTES / "more-results.md", "More results", _MORE_HEAD, MORE),
)

#: Pages with figures between marks, and what writes them, from the first mark on.
MARKED = {_README: (_figures, _absence), DOCS / "tutorial.md": (_choice,)}


if __name__ == "__main__":
    found = records()
    for page in PAGES:
        page.path.write_text(written(page, found), encoding="utf-8")
    for path in MARKED:
        path.write_text(with_figures(path, found), encoding="utf-8")

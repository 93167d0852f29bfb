"""The log of a run: NDJSON and CSV contain each track at once, and are continued after a crash."""

import csv
import errno
import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from itertools import count, product
from math import inf
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from catstream.base.box import Box
from catstream.base.files import REMEDIES
from catstream.errors import VideoError
from catstream.output import remote, track_log
from catstream.output.destinations import Header, Origin, Rotation, SinkOptions, TrackedFrame, open_sink
from catstream.output.track_log import JoinedLog, Log, RunFiles, destinations_of
from catstream.processes.job import Results
from catstream.video.source import open_source
from catstream.wire.messages import Track

TRACKS = [
    Track(0, 0.0, "bootstrapping", Box(10.0, 20.0, 30.5, 40.0), 1.0, 0, checked="keyframe", probability=1.0),
    Track(1, 0.04, "absent", None, 0.125, 3, checked="checked", probability=0.975),
    Track(3, 0.12, "present", Box(-2.0, 21.0, 30.0, 40.0), 0.75, 4, 17.5),
]


def track(frame, name=""):
    box = Box(10.0 + frame, 20.0, 30.0, 40.0) if frame % 4 else None
    return Track(frame, frame / 30, "present" if box else "absent", box, 0.5, frame // 3, object=name)


def filled(path, stack):
    """A file that holds the tracks, as it is before it is closed."""
    sink = open_sink(str(path), Origin())
    stack.callback(sink.close)
    for each in TRACKS:
        sink.write(TrackedFrame([each], 0.25 * each.frame))
    return path


def test_each_track_is_in_the_files_at_once(tmp_path):
    with ExitStack() as stack:
        objects = [json.loads(line) for line in filled(tmp_path / "t.ndjson", stack).read_text().splitlines()[1:]]
        rows = list(csv.DictReader(filled(tmp_path / "t.csv", stack).read_text().splitlines()))
    assert objects == [each.to_dict() for each in TRACKS]
    assert list(rows[0].values()) == ["0", "0.000000", "bootstrapping", "10.0000", "20.0000", "30.5000", "40.0000",
                                      "1.000000", "0", "", "0", "keyframe", "1.000000", "0.000000"]  # fmt: skip
    assert [row["state"] for row in rows] == [each.state for each in TRACKS]
    assert [row["processing"] for row in rows] == ["0.000000", "0.250000", "0.750000"]
    assert (rows[1]["x"], rows[1]["h"]) == ("", "")


@pytest.mark.parametrize("suffix", [".ndjson", ".csv"])
def test_open_log_is_read_up_to_a_torn_line_without_blank_ones(tmp_path, suffix):
    expected = [replace(each, pts=None) for each in TRACKS] if suffix == ".csv" else TRACKS
    with ExitStack() as stack:
        path = filled(tmp_path / f"t{suffix}", stack)
        whole = path.read_bytes()
        torn = [whole + end for end in (b"", whole.splitlines()[-1][:9] + bytes(7), bytes(4096), b"\n")]
        for content in (*torn, whole.replace(b"\n", b"\n\n")):
            path.write_bytes(content)
            assert [frame.tracks for frame in Log(path)] == [[track] for track in expected]
        path.write_bytes(whole[:40])  # a part of the first line
        assert list(Log(path)) == []
    assert list(Log(tmp_path / f"none{suffix}")) == []


@pytest.mark.parametrize("disk", [1 << 20], indirect=True)
@pytest.mark.parametrize("source", ["rtsp://cam", "walk.mp4"])
@pytest.mark.parametrize("names", [["t.ndjson"], ["t.csv"], ["t.sqlite"], ["t.ndjson", "t.csv"]], ids=" ".join)
def test_full_disk_costs_rows_of_a_camera_and_ends_a_video_file(disk, fill, names, source, caplog, monkeypatch):
    run = RunFiles(Origin(Header(source=source)), None, [str(disk / name) for name in names])
    frames = iter([TrackedFrame([track(number, "anna"), track(number, "ben")]) for number in range(10_000)])
    with run.opened("run") as outputs, ExitStack() as stack:
        for _ in range(20):
            outputs.write(next(frames))
        ballast = fill()
        if source == "walk.mp4":
            stack.enter_context(
                pytest.raises(VideoError, match=r"cannot write .*(No space left on device|disk is full)")
            )
        while outputs.missed < 50:
            outputs.write(next(frames))
        assert "free space on the disk" in outputs.trouble
        ballast.unlink()
        for _ in range(20):
            outputs.write(next(frames))
        assert outputs.trouble, "it holds for some seconds"
        monkeypatch.setattr(remote, "_STABLE_SECONDS", 0)
        outputs.write(next(frames))
        assert not outputs.trouble
    for log in (Log(disk / name) for name in names):
        numbers = [frame.number for frame in log if len(frame.tracks) == 2]
        lacking = numbers[-1] + 1 - len(numbers)
        assert numbers == sorted(numbers)
        assert (lacking > 0) == (source == "rtsp://cam")
        assert log.gap == (lacking if log.path.suffix == ".ndjson" else 0)
        if source == "rtsp://cam":
            assert numbers[-20:] == [*range(numbers[-1] - 19, numbers[-1] + 1)]
            assert caplog.text.count(f"{log.path.name}' (No space") <= 1, "it is said once"


@pytest.mark.parametrize("disk", [1 << 20], indirect=True)
@pytest.mark.parametrize(("state", "remedy"), [("full", "free space on the disk"), ("read-only", "mount it writable")])
@pytest.mark.parametrize("name", ["t.ndjson", "t.csv", "t.sqlite"])
def test_live_run_begins_on_a_full_or_read_only_disk(disk, fill, remount, name, state, remedy, caplog):
    log = Log(disk / "out" / name)
    live, file = (
        RunFiles(Origin(Header(source=source)), disk / "out", [str(log.path)]) for source in ("rtsp://cam", "walk.mp4")
    )
    ballast = fill() if state == "full" else remount("ro")
    live.check(overwrite=False, earlier=[])
    with pytest.raises(VideoError, match=remedy):
        file.opened("run")
    with live.opened("run") as outputs:
        for number in range(12):
            if number == 9 and state == "full":
                ballast.unlink()
            elif number == 9:
                remount("rw")
            outputs.write(TrackedFrame([track(number)]))
    assert [frame.number for frame in log] == [9, 10, 11]
    assert outputs.missed == 9
    assert log.gap == (9 if name == "t.ndjson" else 0)
    (message,) = caplog.messages
    assert str(log.path) in message
    assert remedy in message


@pytest.mark.parametrize("code", [errno.EIO, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_disk_error_is_logged_once_and_costs_the_rows_meanwhile(tmp_path, code, monkeypatch, caplog):
    def fail(*_):
        raise OSError(code, os.strerror(code))

    log = Log(tmp_path / "t.ndjson")
    with RunFiles(Origin(Header(source="rtsp://cam")), None, [str(log.path)]).opened("run") as outputs:
        for number in range(9):
            with monkeypatch.context() as disk:
                if 3 <= number < 6:
                    disk.setattr(os, "write", fail)
                outputs.write(TrackedFrame([track(number)]))
    assert [frame.number for frame in log] == [0, 1, 2, 6, 7, 8]
    assert log.gap == outputs.missed == 3
    (message,) = caplog.messages
    assert f"cannot write '{log.path}' ({os.strerror(code)}): {REMEDIES.get(code, 'use another folder')}" in message


def test_log_that_cannot_be_renamed_grows(tmp_path, monkeypatch, caplog):
    path = tmp_path / "t.ndjson"
    origin = Origin(Header(source="rtsp://cam"), options=SinkOptions(rotate=Rotation(inf, 1000)))
    with RunFiles(origin, None, [str(path)]).opened("run") as outputs, monkeypatch.context() as folder:
        folder.setattr(Path, "rename", partial(os.rename, path.parent / "none"))
        for number in range(50):
            outputs.write(TrackedFrame([track(number)]))
    assert [frame.number for frame in Log(path)] == [*range(50)]
    (message,) = caplog.messages
    assert message.endswith("use another folder")


@pytest.mark.parametrize("source", ["rtsp://cam", "walk.mp4"])
def test_logs_of_a_live_source_rotate_together_and_are_joined(tmp_path, source, monkeypatch, caplog):
    clock = count(1_800_000_000)
    monkeypatch.setattr(track_log, "time", SimpleNamespace(time=lambda: next(clock)))
    options = SinkOptions(rotate=Rotation(inf, 1000), keep=5)
    run = RunFiles(
        Origin(Header(source=source), options=options), None, [str(tmp_path / "t.ndjson"), str(tmp_path / "t.csv")]
    )
    (tmp_path / "t-other.csv").touch()
    with run.opened("run") as outputs:
        for number in range(50):
            outputs.write(TrackedFrame([track(number)]))
    files = {suffix: sorted(tmp_path.glob(f"t*{suffix}")) for suffix in (".ndjson", ".csv")}
    files[".csv"].remove(tmp_path / "t-other.csv")
    assert [file.stem for file in files[".csv"]] == [file.stem for file in files[".ndjson"]]
    assert len(files[".csv"]) == (6 if source == "rtsp://cam" else 1)
    for paths in files.values():
        numbers = [frame.number for frame in JoinedLog(Log(path) for path in reversed(paths))]
        assert numbers == [*range(numbers[0], 50)]
        assert (numbers[0] > 0) == (source == "rtsp://cam")
    assert not caplog.text
    with run.opened("run", resume=True) as outputs:
        outputs.write(TrackedFrame([track(50)]))
    assert {[*Log(paths[-1])][-1].number for paths in files.values()} == {50}
    with pytest.raises(VideoError, match=r"has frame \d+ again: pass the files of one run"):
        list(JoinedLog([Log(tmp_path / "t.csv"), Log(tmp_path / "t.csv")]))


def test_log_rotates_in_a_new_period_in_utc(tmp_path):
    daily = SinkOptions(rotate=Rotation(86400, inf))
    with closing(open_sink(str(tmp_path / "t.csv"), Origin(options=daily))) as sink:
        sink.write(TrackedFrame(TRACKS[:1]))
        midnight = (tmp_path / "t.csv").stat().st_mtime // 86400 * 86400 + 86400
        assert [sink.must_rotate(now) for now in (midnight - 1, midnight)] == [False, True]


@pytest.mark.parametrize("disk", [4096], indirect=True)
def test_new_file_is_removed_if_its_first_line_does_not_fit(disk):
    (disk / "ballast").write_bytes(bytes(4096))
    with pytest.raises(VideoError, match="No space left on device"):
        open_sink(str(disk / "t.csv"), Origin())
    assert [file.name for file in disk.iterdir()] == ["ballast"]


def run_in(folder, *more):
    """The files of a run in a folder."""
    output = folder / "out"
    places = [*destinations_of("walk", Results(output, False)), *(str(folder / name) for name in more)]
    return RunFiles(Origin(), output, places)


def add(run, history, first=0, resume=False):
    """Write the frames of a run from the first one on; a history has the names of the objects in each frame."""
    with run.opened("", resume=resume) as files:
        for number, names in enumerate(history):
            if number >= first:
                files.write(TrackedFrame([track(number, name) for name in names], 0.01))


def rows_of(run):
    """The rows of all logs, without the processing times, which a log that was cut may lack."""
    logs = [Path(dest) for dest in run.destinations if not dest.endswith(".mp4")]
    ends = {path: "," if path.suffix == ".csv" else "}" for path in logs}
    return {path.name: [line.rpartition(ends[path])[0] for line in path.read_text().splitlines()] for path in logs}


#: The objects of each frame: a few come, go and come again.
ALIVE = st.lists(st.sampled_from(["", "anna", "ben", "carl"]), min_size=1, unique=True)
HISTORIES = st.lists(ALIVE, min_size=2, max_size=5)


@settings(max_examples=120)
@given(HISTORIES, st.data())
def test_resumed_run_has_each_row_once_wherever_a_crash_cut_it(history, data):
    """The run is resumed with a new file and some of its files; the others stay as they are."""
    with tempfile.TemporaryDirectory() as place:
        whole, broken = run_in(Path(place) / "whole", "t.csv"), run_in(Path(place) / "broken")
        add(whole, history)
        add(broken, history)
        for log in broken.destinations:
            size = Path(log).stat().st_size
            os.truncate(log, size - data.draw(st.integers(0, size)))
        selected = data.draw(st.lists(st.sampled_from(broken.destinations), min_size=1, unique=True))
        dropped = {log: Path(log).read_bytes() for log in {*broken.destinations} - {*selected}}
        again = replace(broken, destinations=[*selected, str(Path(place) / "broken" / "t.csv")])
        add(again, history, again.position()[0], resume=True)
        assert rows_of(again).items() <= rows_of(whole).items()
        assert len(rows_of(again)) == len(again.destinations)
        assert dropped == {log: Path(log).read_bytes() for log in dropped}


def test_existing_files_are_replaced_or_continued_on_request_only(tmp_path):
    run = run_in(tmp_path, "t.csv")
    add(run, [[""]] * 2)
    with pytest.raises(VideoError, match=r"walk\.ndjson exists already: replace it with --overwrite"):
        run.check(overwrite=False, earlier=[])
    run.check(overwrite=True, earlier=[])
    run.check(overwrite=False, earlier=run.destinations)
    with pytest.raises(VideoError, match=r"t\.csv exists already"):
        run.check(overwrite=False, earlier=run.destinations[:2])
    video = RunFiles(Origin(), None, [str(tmp_path / "t.mp4")])
    (tmp_path / "t.mp4").touch()
    with pytest.raises(VideoError, match=r"t\.mp4 cannot be continued: pass other destinations to resume"):
        video.check(overwrite=False, earlier=video.destinations)


@pytest.mark.parametrize(
    ("source", "destination", "error"),
    [
        ("walk.mp4", "t.xls", r"one of .ndjson, -, .csv, .*where - is"),
        ("walk.mp4", "t.txt", "for other formats use catstream export"),
        ("walk.mp4", "none/t.csv", "an existing folder that you may write to"),
        ("walk.mp4", "walk.mp4", r"walk\.mp4 is the source, which would be lost"),
        ("rtsp://127.0.0.1/cam", "t.mp4", "but rtsp://127.0.0.1/cam is live"),
    ],
)
def test_invalid_destination_is_rejected_before_the_run(tmp_path, monkeypatch, source, destination, error):
    monkeypatch.chdir(tmp_path)
    Path("walk.mp4").touch()
    with pytest.raises(VideoError, match=error):
        RunFiles(Origin(Header(source=source)), None, [destination]).check(overwrite=True, earlier=[])
    assert [file.name for file in tmp_path.iterdir()] == ["walk.mp4"]


def test_video_has_the_frames_of_its_tracks(demo_video, tmp_path):
    source, _ = demo_video(8)
    header = Header(source=str(source), start=1, stride=2)  # frames 1, 3, 5, 7, counted 0 to 3
    sink = open_sink(str(tmp_path / "walk.mp4"), Origin(header))
    for each in TRACKS:
        sink.write(TrackedFrame([each]))
    with pytest.raises(VideoError, match="has no frame 4"):
        sink.write(TrackedFrame([track(4)]))
    sink.close()
    with open_source(str(tmp_path / "walk.mp4")) as frames:
        assert sum(1 for _ in frames) == len(TRACKS)


@pytest.mark.parametrize("name", ["t.ndjson", "t.csv"])
@pytest.mark.parametrize("damage", [b"?\n", b"\0\0\0\n", b"null\n", b'{"frame": "7"}\n', b"7,0.2\n"])
def test_damaged_line_is_an_error_with_its_number_or_skipped(tmp_path, name, damage):
    log = tmp_path / name
    add(RunFiles(Origin(), None, [str(log)]), [[""]] * 9)
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join([*lines[:5], damage, *lines[5:]]))
    for read in (lambda: list(Log(log)), RunFiles(Origin(), None, [str(log)]).position):
        with pytest.raises(VideoError, match=rf"{name}, line 6 is not a track .*--skip-damaged"):
            read()
    skipping = Log(log, skip_damaged=True)
    assert [frame.number for frame in skipping] == list(range(9))
    assert skipping.damaged == 1
    assert RunFiles(Origin(), None, [str(log)]).position(skip_damaged=True)[0] == 9


COLUMNS = ["frame", "seconds", "state", "x", "y", "w", "h", "score", "model_version", "object", "source_frame",
           "processing"]  # fmt: skip


def table(path, columns=COLUMNS, separator=",", change=lambda rows: rows, encoding="utf-8", ending="\n"):
    """A CSV log of two objects that a table program has written."""
    rows = [
        dict(zip(COLUMNS, [frame, frame / 25, "present", x, 20, 30, 40, 0.9, 1, name, 2 * frame, ""], strict=True))
        for frame in range(5)
        for x, name in ((10 + frame, "anna"), (200, "ben"))
    ]
    lines = [columns, *([str(row.get(column, "?")) for column in columns] for row in change(rows))]
    path.write_bytes(ending.join(map(separator.join, lines)).encode(encoding))
    return path


@pytest.mark.parametrize(
    "form",
    [
        {"columns": COLUMNS[::-1]},
        {"columns": ["", *COLUMNS[:-1], "note"]},
        {"separator": ";", "encoding": "utf-8-sig", "ending": "\r\n;;;;;;;;;;;;\r\n"},
        {"change": lambda rows: sorted(rows, key=lambda row: row["object"])},
        {"change": lambda rows: rows[::-1]},
    ],
)
def test_csv_is_read_by_column_names_in_any_order_of_rows(tmp_path, form):
    frames = list(Log(table(tmp_path / "t.csv", **form)))
    assert [frame.number for frame in frames] == list(range(5))
    for frame in frames:
        boxes = {track.object: track.box for track in frame.tracks}
        assert boxes == {"anna": Box(10 + frame.number, 20, 30, 40), "ben": Box(200, 20, 30, 40)}
        assert {track.source_frame for track in frame.tracks} == {2 * frame.number}


@pytest.mark.parametrize(
    ("form", "words"),
    [
        ({"columns": COLUMNS[1:]}, "lacks the column frame"),
        ({"columns": [*COLUMNS[:3], *COLUMNS[5:]]}, "lacks the column x, y"),
        ({"change": lambda rows: [row | {"state": "hidden"} for row in rows]}, "line 2 .* state: expected .* 'hidden'"),
        ({"change": lambda rows: [*rows, rows[3]]}, "two rows of ben in frame 1"),
        ({"change": lambda rows: [row | {"frame": 0.5} for row in rows]}, "line 2 .* whole number"),
    ],
)
def test_ambiguous_csv_file_is_an_error(tmp_path, form, words):
    with pytest.raises(VideoError, match=words):
        list(Log(table(tmp_path / "t.csv", **form)))


@pytest.mark.parametrize("name", ["t.ndjson", "t.csv", "t.sqlite"])
def test_log_of_another_process_is_rejected_with_its_pid(tmp_path, name):
    program = (
        "import sys; from catstream.output.destinations import Header, Origin, open_sink\n"
        "sink = open_sink(sys.argv[1], Origin()); print('open', flush=True); sys.stdin.read()"
    )
    path = tmp_path / name
    command = [sys.executable, "-P", "-c", program, path]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as writer:
        writer.stdout.readline()
        run = RunFiles(Origin(), None, [str(path)])
        for refused in (lambda: run.check(overwrite=True, earlier=[]), lambda: open_sink(str(path), Origin())):
            with pytest.raises(VideoError, match=rf"{name} is being written by process {writer.pid}: stop it"):
                refused()
        writer.kill()
    run.check(overwrite=True, earlier=[])
    open_sink(str(path), Origin()).close()


CHANGES = {
    "removed": Path.unlink,
    "renamed": lambda path: path.rename(path.with_name("t.old")),
    "replaced": lambda path: (path.unlink(), path.touch()),
    "moved": lambda path: path.parent.rename(path.parent.with_name("old")),
    "truncated": lambda path: os.truncate(path, 0),
}


@pytest.mark.parametrize(
    ("name", "change"), sorted({*product(["t.ndjson", "t.csv", "t.sqlite"], CHANGES)} - {("t.sqlite", "truncated")})
)
def test_removed_or_truncated_log_is_written_anew(tmp_path, caplog, name, change):
    path = tmp_path / "out" / name
    path.parent.mkdir()
    with closing(open_sink(str(path), Origin())) as sink:
        for number in range(6):
            sink.write(TrackedFrame([track(number)]))
            if number == 2:
                CHANGES[change](path)
    assert [frame.number for frame in Log(path)] == [3, 4, 5]
    assert b"\0" not in path.read_bytes() or name == "t.sqlite"
    (message,) = caplog.messages
    assert "truncated by another program" in message or "removed or renamed by another program" in message


def test_resumed_run_makes_csv_and_database_from_its_ndjson_log(tmp_path):
    places = [str(tmp_path / name) for name in ("t.csv", "t.sqlite", "t.ndjson")]
    run = RunFiles(Origin(), None, places)
    add(run, [[""]] * 5)
    Path(places[0]).write_text("damaged by a power cut")
    Path(places[1]).unlink()
    add(run, [[""]] * 9, first=run.position()[0], resume=True)
    for place in places:
        assert [frame.number for frame in Log(Path(place))] == list(range(9))


def test_link_to_another_file_of_the_run_is_rejected(tmp_path):
    log = tmp_path / "t.csv"
    log.touch()
    (tmp_path / "sub").mkdir()
    (tmp_path / "soft").symlink_to(log)
    (tmp_path / "hard").hardlink_to(log)
    for other in (tmp_path / "sub" / ".." / "t.csv", tmp_path / "soft", tmp_path / "hard"):
        with pytest.raises(VideoError, match=r"is both the destination .*t\.csv and the saved model of anna"):
            RunFiles(Origin(), None, [str(log)]).check(
                overwrite=True, earlier=[], others={"the saved model of anna": other}
            )


def test_concatenated_logs_are_read_with_the_first_header(tmp_path):
    tracks = [json.dumps(track(number).to_dict()) for number in (0, 1)]
    parts = [Header(size=(4, 3)).to_json(), tracks[0], Header().to_json(), tracks[1]]
    log = tmp_path / "t.ndjson"
    log.write_text("".join(f"{part}\n" for part in parts))
    assert [frame.number for frame in Log(log)] == [0, 1]
    assert Log(log).header() == Header(size=(4, 3))

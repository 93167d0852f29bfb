"""The files of one run: complete, resumed at the frame that all of them hold, and never written over in silence."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.sinks.lines import LineFile
from catstream.sinks.run import RunFiles
from catstream.sinks.sink import STDOUT, open_files
from catstream.video.rendered import write
from catstream.video.source import ALL_FRAMES, open_source

NAMES = ["t.ndjson", "t.json", "t.csv", "t.txt", "t.sqlite", "t.parquet", "t.mp4"]


def track(frame):
    box = Box(10.0 + frame, 20.0, 30.0, 40.0) if frame % 4 else None
    return Track(frame + 1, frame, frame / 30, "present" if box else "absent", box, 0.5, frame // 3)


def frame_of(number, names):
    """The tracks of a frame of several objects."""
    return {name: replace(track(number), object=name) for name in names}


@pytest.fixture
def files(tmp_path):
    """The files of a run over a short video, in all formats."""
    source, _ = write(tmp_path, 12, (320, 240))

    def make(folder, names=NAMES, output=True):
        (tmp_path / folder).mkdir(exist_ok=True)
        results = tmp_path / folder / "out" if output else None
        return RunFiles("demo", str(source), ALL_FRAMES, results, output, [tmp_path / folder / name for name in names])

    return make


def fill(files, first, last, resume=False):
    with files.opened(resume=resume) as keep:
        for frame in range(first, last):
            keep({"": track(frame)}, 0.01)


def held(files):
    """What the files of a run hold, in the form in which two runs can be compared."""
    texts = [path.read_text() for path in files.files if path.suffix in (".ndjson", ".json", ".csv", ".txt")]
    with closing(sqlite3.connect(files.files[0].with_suffix(".sqlite"))) as database:
        rows = [database.execute("SELECT * FROM tracks").fetchall()]
    rows.append(parquet.read_table(files.files[0].with_suffix(".parquet")).to_pylist())
    results = [path.read_text() for path in sorted(files.output.iterdir()) if path.suffix != ".mp4"]
    lengths = []
    for film in [files.output / "demo.mp4", *(path for path in files.files if path.suffix == ".mp4")]:
        with open_source(film) as frames:
            lengths.append(sum(1 for _ in frames))
    return texts, rows, results, lengths


@pytest.mark.parametrize("killed", [False, True], ids=["ended", "killed"])
def test_a_run_that_is_resumed_leaves_the_files_of_one_in_one_go(files, tmp_path, killed):
    whole, broken = files("whole"), files("broken")
    fill(whole, 0, 12)
    if killed:
        with broken.opened() as keep:
            for frame in range(7):
                keep({"": track(frame)}, 0.01)
            shutil.copytree(tmp_path / "broken", tmp_path / "left")
        shutil.rmtree(tmp_path / "broken")
        (tmp_path / "left").rename(tmp_path / "broken")
    else:
        fill(broken, 0, 7)
    torn = tmp_path / "broken" / "t.ndjson"
    torn.write_bytes(b"".join(torn.read_bytes().splitlines(keepends=True)[:6]) + b'{"seq": 7')
    assert broken.position() == 6
    fill(broken, 6, 12, resume=True)
    assert held(broken) == held(whole)


def test_a_database_alone_is_complete_after_a_kill_and_a_resume(files, tmp_path):
    broken, copy = files("broken", ["t.sqlite"], output=False), tmp_path / "left"
    with broken.opened() as keep:
        for frame in range(7):
            keep({"": track(frame)}, 0.01)
        shutil.copytree(tmp_path / "broken", copy)
    left = files("left", ["t.sqlite"], output=False)
    left.check_writable(overwrite=False, resumable=True, known=left.files)
    fill(left, left.position(), 12, resume=True)
    with closing(sqlite3.connect(left.files[0])) as database:
        assert [frame for (frame,) in database.execute("SELECT frame FROM tracks")] == list(range(12))
    assert {path.name for path in copy.iterdir()} == {"t.ndjson", "t.sqlite"}


def test_an_ndjson_file_that_another_run_wrote_is_not_replaced_by_one_for_a_database(files):
    run = files("run", ["t.sqlite"], output=False)
    run.files[0].with_name("t.ndjson").write_text("dear to somebody")
    with pytest.raises(VideoError, match=r"t\.ndjson exists already: replace it with --overwrite"):
        run.check_writable(overwrite=False, resumable=False)


def test_a_crash_while_the_files_of_a_resumed_run_are_written_again_loses_nothing(files, monkeypatch):
    run = files("run", ["t.ndjson", "t.txt"])
    fill(run, 0, 7)
    before = {path: path.read_bytes() for path in [*run.files, *run.output.iterdir()] if path.suffix != ".mp4"}
    write, tracks = LineFile.add, iter(range(25))

    def add(file, text):
        if next(tracks, None) is None:
            raise VideoError("the disk is full")
        write(file, text)

    with monkeypatch.context() as crash:
        crash.setattr(LineFile, "add", add)
        with pytest.raises(VideoError, match="the disk is full"):
            fill(run, 7, 12, resume=True)
    assert {path: path.read_bytes() for path in before} == before
    fill(run, run.position(), 12, resume=True)
    whole = files("whole", ["t.ndjson", "t.txt"])
    fill(whole, 0, 12)
    assert rows_of(run) == rows_of(whole)


def test_a_file_that_is_new_when_a_run_is_resumed_gets_all_tracks(files):
    fill(files("run", ["t.csv"]), 0, 7)
    more = files("run", ["t.csv", "t.json", "t.txt"])
    fill(more, more.position(), 9, resume=True)
    assert [row["frame"] for row in json.loads(more.files[1].read_text())] == list(range(9))
    assert len(more.files[2].read_text().splitlines()) == 6, "MOT text has no line where the object is absent"


def test_existing_results_are_rejected_or_if_requested_replaced_together(files, tmp_path):
    earlier = files("run", ["t.csv"])
    fill(earlier, 0, 9)
    for again, words in (
        (files("run", []), "demo.mp4.*--overwrite"),
        (files("run", ["t.csv"], False), "t.csv.*--over"),
    ):
        with pytest.raises(VideoError, match=words):
            again.check_writable(overwrite=False, resumable=False)
    without_video = RunFiles("demo", earlier.source, ALL_FRAMES, earlier.output, False, earlier.files)
    without_video.check_writable(overwrite=True, resumable=False)
    fill(without_video, 0, 3)
    assert len(earlier.files[0].read_text().splitlines()) == 4
    assert not (earlier.output / "demo.mp4").exists(), "a video of other results would lie beside them"
    other = RunFiles("street", earlier.source, ALL_FRAMES, earlier.output)
    other.check_writable(overwrite=False, resumable=False)
    fill(other, 0, 5)
    assert len((tmp_path / "run" / "out" / "demo.csv").read_text().splitlines()) == 4, "each source has its own table"


@pytest.mark.parametrize(
    ("names", "resumable", "words"),
    [
        (["t.xls"], False, "ends with .ndjson"),
        (["none/t.csv"], False, "a folder that exists"),
        (["t.csv", "t.csv"], False, "named twice"),
        (["t.csv", "../run/t.csv"], False, "named twice"),
        (["t.txt", "t.mp4"], True, "does not hold all tracks"),
        ([f"{'t' * 244}.csv"], False, "too long"),
    ],
)
def test_results_that_cannot_be_written_are_rejected_before_the_run(files, names, resumable, words):
    with pytest.raises(VideoError, match=words):
        files("run", names, output=False).check_writable(overwrite=False, resumable=resumable)


@pytest.mark.parametrize("name", ["demo.txt", "demo.csv", "demo.mp4"])
def test_a_file_of_the_results_is_given_to_no_other_format(files, name):
    run = files("run", [f"out/../out/{name}"])
    run.output.mkdir()
    with pytest.raises(VideoError, match=f"{name} is named twice, or is a file of the results"):
        run.check_writable(overwrite=True, resumable=False)


def test_the_video_may_be_written_beside_results_that_have_none(files):
    run = replace(files("run", ["out/demo.mp4"]), video=False)
    run.check_writable(overwrite=True, resumable=False)
    run.make_folder()
    fill(run, 0, 3)
    assert run.files[0].exists()


def test_names_of_results_that_are_too_long_for_a_file_are_rejected_before_the_run(files, tmp_path):
    source = files("run").source
    for name, objects, words in (("s" * 244, [], "give the source"), ("s" * 200, ["a" * 64], "or the object")):
        run = RunFiles(name, source, ALL_FRAMES, tmp_path, objects=objects)
        with pytest.raises(VideoError, match=words):
            run.check_writable(overwrite=False, resumable=False)


def test_a_file_of_another_program_is_not_continued(files):
    run = files("run", ["t.csv"], output=False)
    with open_files(run.files) as (other,):
        other.write([track(0)])
    with pytest.raises(VideoError, match="exists already"):
        run.check_writable(overwrite=False, resumable=True)
    run.check_writable(overwrite=False, resumable=True, known=run.files)


def test_standard_output_has_a_line_of_json_for_each_track(files, capsys):
    run = RunFiles("demo", files("run").source, ALL_FRAMES, files=[STDOUT])
    run.check_writable(overwrite=False, resumable=True)
    fill(run, 0, 5)
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [track(k).to_dict() for k in range(5)]


#: The objects of each frame: a few come, go and come again.
NAMES_IN_FRAME = st.lists(st.sampled_from(["", "anna", "ben", "carl"]), min_size=1, unique=True)
HISTORIES = st.lists(NAMES_IN_FRAME, min_size=2, max_size=5)

#: Formats of which a crash can leave any number of bytes, and the results files.
CUT = ["t.ndjson", "t.csv", "t.txt"]


def test_no_file_of_an_object_of_replaced_results_is_left(tmp_path):
    run = in_folder(tmp_path, [])
    add(run, [["anna", ""], ["ben"]])
    add(run, [["carl"]])
    rows = ("walk-carl.txt", "walk-carl_confidence.value", "walk-carl_time.value")
    assert {path.name for path in run.output.iterdir()} == {*rows, "walk.csv"}


def in_folder(folder, names=CUT):
    return RunFiles("walk", "", ALL_FRAMES, folder / "out", files=[folder / name for name in names])


def add(run, history, first=0, resume=False):
    with run.opened(resume=resume) as keep:
        for number, names in enumerate(history):
            if number >= first:
                keep(frame_of(number, names), 0.01)


def rows_of(run):
    """The rows of all files but those of measured times."""
    paths = [*run.files, *(path for path in run.output.iterdir() if not path.stem.endswith("_time"))]
    return {path.name: path.read_text() for path in paths if path.suffix != ".mp4"}


@settings(max_examples=120)
@given(HISTORIES, st.data())
def test_wherever_a_crash_cuts_the_files_no_row_is_lost_or_doubled(history, data):
    with tempfile.TemporaryDirectory() as place:
        whole, broken = (in_folder(Path(place) / name) for name in ("whole", "broken"))
        whole.output.mkdir(parents=True)
        add(whole, history)
        shutil.copytree(Path(place) / "whole", Path(place) / "broken")
        paths = st.sampled_from([*broken.files, *sorted(broken.output.iterdir())])
        for path in data.draw(st.lists(paths, min_size=1, max_size=2, unique=True)):
            size = path.stat().st_size
            os.truncate(path, size - data.draw(st.integers(0, min(size, 400)), path.name))
        add(broken, history, broken.position(), resume=True)
        assert rows_of(broken) == rows_of(whole)


@pytest.mark.parametrize("name", ["t.ndjson", "t.csv"])
def test_a_frame_counts_only_if_it_is_whole_at_each_byte_at_which_a_file_can_end(tmp_path, name):
    history = [["anna", "ben"], ["anna", "ben", "carl"], ["carl", "ben", "anna"]]
    run = RunFiles("walk", "", ALL_FRAMES, files=[tmp_path / name])
    add(run, history)
    data = run.files[0].read_bytes()
    lines = data.splitlines(keepends=True)
    tracks = [line for line in lines if b"present" in line or b"absent" in line]
    begin = data.index(tracks[2])  # frame 1
    for end in range(begin, len(data) + 1):
        run.files[0].write_bytes(data[:end])
        held = sum(line in data[:end] for line in tracks)
        assert run.position() == (3 if held == 8 else 2 if held >= 5 else 1 if held > 2 else 0)


def test_files_that_an_earlier_run_left_of_an_object_are_seen_before_the_run_and_replaced_only_if_told_so(files):
    run = files("run", [])
    with run.opened(resume=False) as keep:
        keep(frame_of(0, ["anna", "carla"]), 0.01)
    run.output.joinpath("demo.csv").unlink()
    source_of_such_a_name = run.output / "demo-2.csv"
    for name in ("demo-2.csv", "demo-2.txt", "demo-2_confidence.value", "demo-2_time.txt"):
        (run.output / name).write_text("kept")
    with pytest.raises(VideoError, match=r"already \(demo-anna\.txt.*demo-carla\.txt"):
        run.check_writable(overwrite=False, resumable=False)
    run.check_writable(overwrite=True, resumable=False)
    with run.opened(resume=False) as keep:
        keep(frame_of(0, [""]), 0.01)
        keep(frame_of(1, ["", "carla"]), 0.01)
    assert len((run.output / "demo-carla.txt").read_text().splitlines()) == 2
    assert not (run.output / "demo-anna.txt").exists()
    assert source_of_such_a_name.read_text() == (run.output / "demo-2.txt").read_text() == "kept"


def test_the_video_that_is_tracked_is_neither_replaced_nor_removed(files):
    source = Path(files("a").source)
    content = source.read_bytes()
    beside = replace(files("a"), output=source.parent, video=False, files=[])
    beside.check_writable(overwrite=False, resumable=False)
    fill(beside, 0, 3)
    beside.check_writable(overwrite=True, resumable=False)
    fill(beside, 0, 3)
    assert source.read_bytes() == content
    for lost in replace(beside, video=True), replace(beside, output=None, files=[source]):
        with pytest.raises(VideoError, match=r"demo\.mp4 is the source, which would be lost"):
            lost.check_writable(overwrite=True, resumable=False)

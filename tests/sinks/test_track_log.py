"""The log of a run: NDJSON and CSV hold every track at once, and are continued where a crash has cut them."""

import csv
import json
import os
import tempfile
from contextlib import ExitStack
from dataclasses import asdict, replace
from math import isnan
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from catstream.base.box import Box
from catstream.errors import VideoError
from catstream.jobs.job import Results
from catstream.messages.kinds import Track
from catstream.sinks.destinations import Origin, TrackedFrame, open_sink
from catstream.sinks.track_log import RunFiles, places_of, read_frames
from catstream.video.rendered import write
from catstream.video.source import open_source

BOX = Box(10.0, 20.0, 30.5, 40.0)
TRACKS = [
    Track(1, 0, 0.0, "bootstrapping", BOX, 1.0, 0),
    Track(2, 1, 0.04, "absent", None, 0.125, 3),
    Track(4, 3, 0.12, "present", Box(-2.0, 21.0, 30.0, 40.0), 0.75, 4, 17.5),
]


def track(frame, name=""):
    box = Box(10.0 + frame, 20.0, 30.0, 40.0) if frame % 4 else None
    return Track(frame + 1, frame, frame / 30, "present" if box else "absent", box, 0.5, frame // 3, object=name)


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
    assert objects == [{**asdict(each), "box": each.box and list(each.box)} for each in TRACKS]
    assert list(rows[0].values()) == ["0", "0.000000", "bootstrapping", "10.0000", "20.0000", "30.5000", "40.0000",
                                      "1.000000", "0", "", "0", "0.000000"]  # fmt: skip
    assert [row["state"] for row in rows] == [each.state for each in TRACKS]
    assert [row["processing"] for row in rows] == ["0.000000", "0.250000", "0.750000"]
    assert (rows[1]["x"], rows[1]["h"]) == ("", "")


@pytest.mark.parametrize("suffix", [".ndjson", ".csv"])
def test_an_open_file_is_read_back_up_to_a_line_that_a_power_cut_tore(tmp_path, suffix):
    with ExitStack() as stack:
        path = filled(tmp_path / f"t{suffix}", stack)
        kept = [replace(each, seq=each.frame + 1, pts=None) for each in TRACKS] if suffix == ".csv" else TRACKS
        whole = path.read_bytes()
        for torn in (b"", whole.splitlines()[-1][:9] + bytes(7), whole.splitlines()[-1]):
            path.write_bytes(whole + torn)
            found = [frame for frame, _ in read_frames(path)]
            assert [frame.tracks for frame in found] == [[each] for each in kept]
        assert isnan(found[1].seconds) if suffix == ".ndjson" else found[1].seconds == 0.25
    assert list(read_frames(tmp_path / f"none{suffix}")) == []


@pytest.mark.parametrize("name", ["t.ndjson", "t.csv"])
def test_a_full_disk_is_reported_in_one_line_and_written_rows_are_kept(tmp_path, full, name):
    sink = open_sink(str(tmp_path / name), Origin())
    sink.write(TrackedFrame(TRACKS[:1]))
    full(tmp_path / name)
    for last in (lambda: sink.write(TrackedFrame(TRACKS[1:2])), sink.close):  # which tries it once more
        with pytest.raises(VideoError, match=rf"cannot write '.*/{name}' \(No space left on device\)"):
            last()
    assert len(list(read_frames(tmp_path / name))) == 1


@pytest.mark.parametrize("disk", [4096], indirect=True)
def test_a_new_file_whose_first_line_the_disk_does_not_take_is_not_left(disk):
    (disk / "ballast").write_bytes(bytes(4096))
    with pytest.raises(VideoError, match="No space left on device"):
        open_sink(str(disk / "t.csv"), Origin())
    assert [file.name for file in disk.iterdir()] == ["ballast"]


def run_in(folder, *more):
    """The files of a run in a folder."""
    output = folder / "out"
    places = [*places_of("walk", Results(output, False)), *(str(folder / name) for name in more)]
    return RunFiles(Origin(), output, places)


def add(run, history, first=0, resume=False):
    """Write the frames of a run from the first one on; a history has the names of the objects in each frame."""
    run.make_folder()
    with run.opened("", resume=resume) as keep:
        for number, names in enumerate(history):
            if number >= first:
                keep(TrackedFrame([track(number, name) for name in names], 0.01))


def rows_of(run):
    """The rows of all logs, without the processing times, which a log that was cut may lack."""
    return {Path(place).name: [line.rpartition("," if place.endswith("csv") else "}")[0]
            for line in Path(place).read_text().splitlines()] for place in run.places if place[-1] != "4"}  # fmt: skip


#: The objects of each frame: a few come, go and come again.
ALIVE = st.lists(st.sampled_from(["", "anna", "ben", "carl"]), min_size=1, unique=True)
HISTORIES = st.lists(ALIVE, min_size=2, max_size=5)


@settings(max_examples=120)
@given(HISTORIES, st.data())
def test_wherever_a_crash_cuts_the_files_no_row_is_lost_or_doubled(history, data):
    with tempfile.TemporaryDirectory() as place:
        whole, broken = run_in(Path(place) / "whole", "../t.csv"), run_in(Path(place) / "broken")
        add(whole, history)
        add(broken, history)
        for log in broken.places:
            size = Path(log).stat().st_size
            os.truncate(log, size - data.draw(st.integers(0, size)))
        again = replace(broken, places=[*broken.places, str(Path(place) / "t.csv")])  # a file that is new
        add(again, history, broken.position(), resume=True)
        assert rows_of(again) == rows_of(whole)


def test_an_ndjson_file_that_is_new_when_a_run_is_resumed_gets_the_frames_of_its_csv_file(tmp_path):
    run = RunFiles(Origin(), None, [str(tmp_path / "t.csv")])
    add(run, [[""]] * 7)
    more = replace(run, places=[*run.places, str(tmp_path / "t.ndjson")])
    add(more, [[""]] * 9, first=7, resume=True)
    for place in more.places:
        assert [frame.number for frame, _ in read_frames(Path(place))] == list(range(9))
    assert RunFiles(Origin(), None, ["-"]).position() is None, "nothing says which frames there were"


@pytest.mark.parametrize("name", ["t.ndjson", "t.csv"])
def test_a_frame_counts_only_if_it_is_whole_at_each_byte_at_which_a_file_can_end(tmp_path, name):
    run = RunFiles(Origin(), None, [str(tmp_path / name)])
    add(run, [["anna", "ben"], ["anna", "ben", "carl"], ["carl", "ben", "anna"]])
    log = tmp_path / name
    data = log.read_bytes()
    tracks = [line for line in data.splitlines(keepends=True) if b"present" in line or b"absent" in line]
    for end in range(data.index(tracks[2]), len(data) + 1):
        log.write_bytes(data[:end])
        held = sum(line in data[:end] for line in tracks)
        assert run.position() == (3 if held == 8 else 2 if held >= 5 else 1 if held > 2 else 0)


def test_existing_files_are_replaced_only_if_requested_and_continued_only_by_their_own_run(tmp_path):
    run = run_in(tmp_path, "t.csv", "t.mcap")
    add(replace(run, places=run.places[:3]), [[""]] * 2)
    with pytest.raises(VideoError, match=r"walk\.ndjson exists already: replace it with --overwrite"):
        run.check(overwrite=False, earlier=[])
    run.check(overwrite=True, earlier=[])
    run.check(overwrite=False, earlier=run.places)
    with pytest.raises(VideoError, match=r"t\.csv exists already"):
        run.check(overwrite=False, earlier=run.places[:2])
    Path(run.places[3]).touch()
    with pytest.raises(VideoError, match=r"t\.mcap cannot be continued: to resume, give other destinations"):
        run.check(overwrite=False, earlier=run.places)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("t.xls", r"one of .ndjson, -, .csv, .*where - is"),
        ("t.txt", "for other formats use catstream export"),
        ("ftp://host/t.csv", "ftp://host/t.csv is no destination of tracks"),
        ("none/t.csv", "a folder that exists and that you may write to"),
    ],
)
def test_destinations_that_cannot_be_written_are_rejected_before_the_run(tmp_path, name, words):
    place = name if "://" in name else str(tmp_path / name)
    with pytest.raises(VideoError, match=words):
        RunFiles(Origin(), None, [place]).check(overwrite=False, earlier=[])
    assert not list(tmp_path.iterdir())


def test_the_source_is_not_replaced_and_a_live_one_gives_no_video(tmp_path):
    source, _ = write(tmp_path, 4, (320, 240))
    with pytest.raises(VideoError, match=r"demo\.mp4 is the source, which would be lost"):
        RunFiles(Origin(str(source)), None, [str(source)]).check(overwrite=True, earlier=[])
    live = RunFiles(Origin("rtsp://me:secret@127.0.0.1/cam"), None, [str(tmp_path / "t.mp4")])
    with pytest.raises(VideoError, match=r"but rtsp://127.0.0.1/cam is live"):
        live.check(overwrite=False, earlier=[])


def test_a_video_has_the_frames_of_its_tracks(demo_video, tmp_path):
    source, _ = demo_video(8)
    part = slice(1, 8, 2)  # frames 1, 3, 5, 7, counted 0 to 3
    sink = open_sink(str(tmp_path / "walk.mp4"), Origin(str(source), part))
    for each in TRACKS:
        sink.write(TrackedFrame([each]))
    with pytest.raises(VideoError, match="has no frame 4"):
        sink.write(TrackedFrame([track(4)]))
    sink.close()
    with open_source(str(tmp_path / "walk.mp4")) as frames:
        assert sum(1 for _ in frames) == len(TRACKS)

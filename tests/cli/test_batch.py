"""`catstream batch`: the logs of many videos, repeated runs, and a data set of all."""

import csv
import signal
from dataclasses import replace

import psutil
import pytest

from catstream import MultiTracker
from catstream.batch import read_videos
from catstream.output.track_log import Log
from catstream.video.source import open_source

FRAMES = 12


@pytest.fixture
def demo(demo_video, tmp_path):
    """The boxes of a demo video, which is two/cam.mp4 and, cut off, broken.mp4 in a folder."""
    video, boxes = demo_video(FRAMES)
    (tmp_path / "two").mkdir()
    (tmp_path / "two" / "cam.mp4").write_bytes(video.read_bytes())
    (tmp_path / "broken.mp4").write_bytes(video.read_bytes()[:1000])
    return boxes


def table(folder, *rows):
    path = folder / "boxes.csv"
    path.write_text("\n".join(["file,object,x,y,w,h,frame", *rows]) + "\n")
    return path


def summaries(folder):
    with (folder / "batch.csv").open(newline="") as file:
        return {row["video"]: row for row in csv.DictReader(file)}


@pytest.fixture
def batch(said, tmp_path):
    """Runs a batch with results in out: its exit status, its messages, and the rows of batch.csv."""

    def run(*rows):
        code, _, errors = said("batch", table(tmp_path, *rows), "--output", tmp_path / "out", "--jobs", 1)
        return code, errors, summaries(tmp_path / "out")

    return run


def test_failed_video_does_not_stop_the_others(demo, batch, tmp_path):
    boxes = f"broken.mp4,,{demo[0]},", f"two/cam.mp4,anna,{demo[0]},", f"two/cam.mp4,ben,{demo[2]},2"
    code, errors, rows = batch(*boxes)
    assert code == 1
    assert "not a video that can be read" in rows["broken.mp4"]["error"]
    assert (rows["two/cam.mp4"]["frames"], rows["two/cam.mp4"]["tracks"]) == ("12", "22")
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"batch.csv", "two_cam.csv", "two_cam.ndjson"}
    assert errors.startswith("tracking 2 videos, 0 complete\n")
    assert "\n1 of 2 (50%), " in errors
    assert "2 of 2 (100%), 0:00:00 left: two/cam.mp4: 12 frames, 100% present\n" in errors


def test_batch_equals_a_tracker_from_the_frame_of_the_box(demo, batch, tmp_path):
    batch(f"two/cam.mp4,anna,{demo[3]},3")
    log = Log(tmp_path / "out" / "two_cam.ndjson")
    tracker, expected = MultiTracker(), []
    with open_source(str(tmp_path / "two" / "cam.mp4"), part=slice(3, None)) as source:
        for frame in source:
            if frame.number == 0:
                tracker.init(frame.image, {"anna": demo[3]}, frame.time)
            else:
                tracker.update(frame.image, time=frame.time)
            expected.append(replace(tracker.tracks["anna"], source_frame=frame.number + 3))
    assert [track for frame in log for track in frame.tracks] == expected
    assert (log.header().start, log.header().source) == (3, str(tmp_path / "two" / "cam.mp4"))


def test_only_failed_or_changed_videos_are_tracked_again(demo, batch, demo_video, tmp_path):
    boxes, log = [f"broken.mp4,,{demo[0]},", f"two/cam.mp4,anna,{demo[0]},"], tmp_path / "out" / "two_cam.ndjson"
    batch(*boxes)
    first = log.stat().st_mtime_ns
    (tmp_path / "broken.mp4").write_bytes(demo_video(FRAMES)[0].read_bytes())
    code, _, rows = batch(*boxes)
    assert (code, log.stat().st_mtime_ns) == (0, first)
    assert not any(row["error"] for row in rows.values())

    _, _, rows = batch(boxes[1], f"two/cam.mp4,anna,{demo[-1]},{FRAMES - 1}")
    assert log.stat().st_mtime_ns != first
    assert rows["two/cam.mp4"]["checked"] == str(FRAMES)


def test_results_of_another_table_are_not_replaced(demo, batch, succeed, fail, demo_video, tmp_path):
    batch(f"two/cam.mp4,anna,{demo[0]},")
    (tmp_path / "three" / "two").mkdir(parents=True)
    for name in ("cam.mp4", "side.mp4"):
        (tmp_path / "three" / "two" / name).write_bytes(demo_video(FRAMES)[0].read_bytes())
    words = ["--output", tmp_path / "out", "--jobs", 1]
    (tmp_path / "two_cam.ndjson").touch()
    assert "two_cam.ndjson exists already" in fail("batch", tmp_path / "boxes.csv", "--output", tmp_path)
    other = table(tmp_path / "three", f"two/cam.mp4,anna,{demo[0]},")
    assert f"two_cam.ndjson is the log of {tmp_path}/two/cam.mp4, not of" in fail("batch", other, *words)
    succeed("batch", table(tmp_path / "three", f"two/side.mp4,anna,{demo[0]},"), *words)
    assert [*summaries(tmp_path / "out")] == ["two/cam.mp4", "two/side.mp4"]
    other = table(tmp_path / "three", f"two/cam.mp4,anna,{demo[0]},")
    succeed("batch", other, *words, "--overwrite")
    assert Log(tmp_path / "out" / "two_cam.ndjson").header().source == f"{tmp_path}/three/two/cam.mp4"


def test_tracks_do_not_depend_on_other_objects(demo, batch, tmp_path):
    def ben(*others):
        batch(*others, f"two/cam.mp4,ben,{demo[3]},3")
        tracks = (track for frame in Log(tmp_path / "out" / "two_cam.ndjson") for track in frame.tracks)
        return [(track.source_frame, track.box, track.doubtful) for track in tracks if track.object == "ben"]

    alone = ben()
    assert (alone[0][0], len(alone)) == (3, FRAMES - 3)
    assert ben(f"two/cam.mp4,anna,{demo[0]},", f"two/cam.mp4,anna,{demo[-1]},{FRAMES - 1}") == alone


def test_results_are_named_by_the_file_without_its_suffix(tmp_path):
    for folder in ("seq.01", "seq.02"):
        (tmp_path / folder).mkdir()
    boxes = table(tmp_path, *(f"{name},,1,2,30,40,0" for name in ("seq.01", "./seq.02", "a/cam.2.mp4")))
    assert [video.name for video in read_videos(boxes)] == ["seq.01", "seq.02", "a_cam.2"]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "boxes.csv has no box"),
        (["a.mp4,anna,1,2,30,x,0"], "line 2: column h: expected a number, got 'x'"),
        ([",anna,1,2,30,40,0"], "line 2: column file: expected the path of a video"),
        (["a.mp4,anna,1,2,30,40,0", "a.mp4,anna,1,2,30,40,0"], "a.mp4: anna has two boxes in frame 0"),
        (["a/b.mp4,,1,2,30,40,0", "a_b.avi,,1,2,30,40,0"], "several videos would have the results a_b"),
    ],
)
def test_invalid_table_is_an_error(fail, tmp_path, rows, message):
    assert message in fail("batch", table(tmp_path, *rows), "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("absent,,,,0", "ben has no box"),
        ("900,0,20,20,0", "ben"),
        ("10,10,20,20,99", "ben: frame 99 is outside the video: pass a frame from 0 to 11"),
    ],
)
def test_invalid_box_is_an_error_of_its_video(demo, batch, row, message):
    code, _, rows = batch(f"two/cam.mp4,anna,{demo[0]},0", f"two/cam.mp4,ben,{row}")
    assert code == 1
    assert rows["two/cam.mp4"]["error"].startswith(message)


def test_logs_of_a_batch_become_one_data_set(demo, succeed, fail, demo_video, tmp_path):
    (tmp_path / "cam.mp4").write_bytes(demo_video(FRAMES)[0].read_bytes())
    boxes = table(tmp_path, f"cam.mp4,ben,{demo[0]},", f"two/cam.mp4,anna,{demo[0]},")
    succeed("batch", boxes, "--output", tmp_path / "out", "--jobs", 1)
    succeed("export", tmp_path / "out", tmp_path / "set", "--format", "yolo")
    assert (tmp_path / "set" / "data.yaml").read_text().endswith('names:\n  0: "ben"\n  1: "anna"\n')
    labels = sorted((tmp_path / "set" / "labels").iterdir())
    assert [file.stem.rpartition("_")[0] for file in labels] == ["cam"] * FRAMES + ["two_cam"] * FRAMES
    assert {file.read_text()[0] for file in labels[FRAMES:]} == {"1"}
    assert "the logs have different sources" in fail("export", tmp_path / "out", tmp_path / "all.xml")
    assert "contains no .ndjson file" in fail("export", tmp_path / "two", tmp_path / "set2", "--format", "yolo")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_batch_completes_after_a_killed_worker_or_ctrl_c(demo_video, catstream, until, tmp_path, number):
    video, boxes = demo_video(60)
    for name in "ab":
        (tmp_path / f"{name}.mp4").write_bytes(video.read_bytes())
    words = ["batch", table(tmp_path, *(f"{name}.mp4,,{boxes[0]}," for name in "ab")), "--output", tmp_path / "out"]
    run = catstream(*words, "--jobs", 1)
    until(lambda: (tmp_path / "out" / "a.ndjson").exists())
    children = psutil.Process(run.pid).children()
    worker = next(child for child in children if "spawn_main" in " ".join(child.cmdline()))
    (worker if number == signal.SIGKILL else run).send_signal(number)
    errors = run.communicate(timeout=500)[1]
    if number == signal.SIGINT:
        assert (run.returncode, "the same command continues" in errors) == (130, True)
        run = catstream(*words)
        errors = run.communicate(timeout=500)[1]
    assert run.returncode == 0, errors
    assert {row["frames"] for row in summaries(tmp_path / "out").values()} == {"60"}

"""A disk that is full before the run has ended: what is lost is said on the terminal, and what was written is kept."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

from catstream.output.track_log import Log

SMALL = 1 << 20  # bytes of a disk for some of the messages of a short video


@pytest.mark.parametrize("disk", [SMALL], indirect=True)
def test_a_model_for_which_the_disk_has_no_room_is_said_and_the_one_before_is_kept(video, said, disk, tmp_path):
    source, box = video
    file = disk / "one.model"
    file.write_bytes(b"the one before")
    code, _, errors = said("track", source, "--box", box, "--output", tmp_path, "--save-model", file, "--overwrite")
    assert code == 1
    assert "No space left on device" in errors
    assert "saved model:" not in errors
    assert file.read_bytes() == b"the one before"
    assert [path.name for path in disk.iterdir()] == ["one.model"]
    assert len((tmp_path / "demo.ndjson").read_text().splitlines()) == 1 + 32


@pytest.mark.parametrize("disk", [SMALL], indirect=True)
def test_checkpoints_for_which_the_disk_has_no_room_are_said_and_the_run_goes_on(video, said, disk, tmp_path):
    source, box = video
    code, _, errors = said("track", source, "--box", box, "--output", tmp_path, "--state", disk / "kept")
    assert "No space left on device" in errors
    assert len((tmp_path / "demo.ndjson").read_text().splitlines()) == 1 + 32
    assert code == 0


@pytest.mark.parametrize("disk", [SMALL], indirect=True)
def test_a_camera_is_tracked_while_the_disk_is_full_and_rows_are_written_again_after_it(
    catstream, succeed, disk, fill, until, tmp_path
):
    log = disk / "out" / "demo-1.ndjson"
    place = ["--endpoint", str(tmp_path / "run")]
    events = tmp_path / "events" / "events.ndjson"
    catstream("sink", f"{events.parent}/", *place)
    run = catstream(
        "track", "demo:1", "--box", "184,88,57,58", "--output", disk / "out", "--set", f"run.endpoint={place[1]}"
    )
    until(lambda: events.exists() and log.read_bytes().count(b"\n") > 10)
    ballast = fill()
    lines = iter(run.stderr.readline, "")
    assert any("No space left on device" in line for line in lines)
    said = until(lambda: [line for line in succeed("status", *place)[0].splitlines() if "writ" in line] or None)
    assert [line.split()[0] for line in said] == ["results", "trouble"]
    (event,) = until(lambda: [line for line in events.read_text().splitlines() if '"write_failed"' in line])
    event = json.loads(event)
    assert event["source"] == "demo:1"
    assert f"cannot write '{log}' (No space left on device)" in event["reason"]
    ballast.unlink()
    until(lambda: b'"gap":' in log.read_bytes().partition(b"\n")[2])
    run.send_signal(signal.SIGINT)
    assert any(line.startswith("not written: ") for line in lines)
    tracks = Log(log)
    numbers = [frame.number for frame in tracks]
    assert 0 < tracks.gap == numbers[-1] + 1 - len(numbers)


@pytest.mark.parametrize("words", [["settings"], ["settings", "--json"], ["track", "--help"]], ids=" ".join)
def test_output_for_which_the_disk_has_no_room_is_one_line_of_error(catstream, words):
    with Path("/dev/full").open("w") as full:
        process = catstream(*words, stdout=full)
        assert process.communicate(timeout=500)[1] == "catstream: cannot write any more: No space left on device\n"
    assert process.returncode == 1


def test_what_is_printed_to_an_output_that_was_closed_is_dropped(program):
    closed = ["sh", "-c", 'exec "$@" >&-', "sh", *program, "settings"]
    process = subprocess.run(closed, stderr=subprocess.PIPE, text=True, check=False)
    assert (process.returncode, process.stderr) == (0, "")

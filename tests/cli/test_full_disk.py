"""A full disk: errors name the lost results, and the written ones remain."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

from catstream.output.track_log import Log

SMALL = 1 << 20  # bytes of a disk for some of the messages of a short video


@pytest.mark.parametrize("disk", [SMALL], indirect=True)
@pytest.mark.parametrize(
    ("options", "status"),
    [(["--save-model", "one.model", "--overwrite"], 1), (["--state", "state"], 0)],
    ids=["model", "checkpoints"],
)
def test_file_without_room_on_the_disk_costs_no_tracks(video, said, disk, tmp_path, options, status):
    (source, box), file = video, disk / "one.model"
    file.write_bytes(b"the earlier one")
    code, _, errors = said("track", source, "--box", box, "--output", tmp_path, *options, cwd=disk)
    assert "No space left on device" in errors
    assert code == status, "a run does not need its checkpoints"
    assert file.read_bytes() == b"the earlier one"
    assert len((tmp_path / "demo.ndjson").read_text().splitlines()) == 1 + 32


@pytest.mark.parametrize("disk", [SMALL], indirect=True)
def test_camera_is_tracked_while_the_disk_is_full(catstream, succeed, disk, fill, until, tmp_path):
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
    assert f"cannot write '{log}' (No space left on device)" in json.loads(event)["reason"]
    ballast.unlink()
    until(lambda: b'"gap":' in log.read_bytes().partition(b"\n")[2])
    run.send_signal(signal.SIGINT)
    assert any(line.startswith("not written: ") for line in lines)
    tracks = Log(log)
    numbers = [frame.number for frame in tracks]
    assert 0 < tracks.gap == numbers[-1] + 1 - len(numbers)


@pytest.mark.parametrize("words", [["settings"], ["settings", "--json"], ["track", "--help"]], ids=" ".join)
def test_output_to_a_full_disk_is_an_error(catstream, words):
    with Path("/dev/full").open("w") as full:
        process = catstream(*words, stdout=full)
        assert process.communicate(timeout=500)[1] == "catstream: cannot write any more: No space left on device\n"
    assert process.returncode == 1


def test_output_to_a_closed_descriptor_is_dropped(program):
    closed = ["sh", "-c", 'exec "$@" >&-', "sh", *program, "settings"]
    process = subprocess.run(closed, stderr=subprocess.PIPE, text=True, check=False)
    assert (process.returncode, process.stderr) == (0, "")

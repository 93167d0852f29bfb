"""A disk that is full or read-only: tracking continues, it is reported, and nothing that was kept is damaged."""

import contextlib
import subprocess

import pytest

from catstream.base.settings import Settings
from catstream.client.attach import subscribe
from catstream.compression.checkpoint_store import CheckpointStore
from catstream.jobs.state import CHECKPOINTS
from catstream.pipeline import Pipeline

#: A small window is soon full, a short pause soon over: the disk is noticed within this video.
SETTINGS = Settings(run={"unstored_frames": 16, "checkpoint_seconds": 0.2})


def fill(disk, _):
    with (disk / "ballast").open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(1 << 16))


def lock(disk, until):
    until(lambda: not remounted("ro", disk).returncode)  # busy while a checkpoint is written


def remounted(how, disk):
    return subprocess.run(["mount", "-o", f"remount,{how}", disk], capture_output=True, check=False)


DISKS = {
    "full": (fill, lambda disk: (disk / "ballast").unlink(), "No space left"),
    "read-only": (lock, lambda disk: remounted("rw", disk), "Read-only file system"),
}


@pytest.mark.parametrize(("spoil", "mend", "reason"), DISKS.values(), ids=DISKS)
def test_a_run_continues_and_reports_a_disk_that_cannot_be_written(long_video, disk, until, spoil, mend, reason):
    path, boxes = long_video
    state, tracks, said = disk / "kept", [], ""
    with Pipeline(path, boxes[0], SETTINGS, state=state) as pipeline:
        for track in pipeline:
            tracks.append(track.frame)
            if track.frame == 15:
                until(lambda: list((state / CHECKPOINTS).glob("*.safetensors")))
                spoil(disk, until)
            if track.frame == 40:
                with subscribe(pipeline.endpoint, "health", timeout=150) as reports:
                    said = next(report.trouble for report in reports if report.trouble)
                assert 0 < CheckpointStore(state / CHECKPOINTS).load(SETTINGS).seq < 40, "what was kept before is whole"
                mend(disk)
    assert reason in said
    assert tracks == list(range(len(boxes)))
    totals = pipeline.totals
    assert totals["sent"] == totals["stored"] == len(boxes), "checkpoints went on once there was room"
    assert CheckpointStore(state / CHECKPOINTS).load(SETTINGS).seq == len(boxes)

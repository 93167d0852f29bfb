"""Under every fault nothing is lost and nothing comes twice: real processes, disks and clocks."""

import chaos
import numpy as np
import pytest
import sequences
import table

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.measure.scores import score

pytestmark = pytest.mark.system


@pytest.mark.parametrize("lockstep", [True, False])
@pytest.mark.parametrize(
    "faults",
    [
        ["kill -9 all three", "kill -9 start server", "kill -9 detector"],
        ["kill -9 compressor", "clock jump", "SIGSTOP, SIGCONT", "kill -9 trainer"],
    ],
    ids=", ".join,
)
def test_no_frame_and_no_row_is_lost_or_comes_twice(video, calm, faults, lockstep):
    assert_kept(video, calm, faults, lockstep)


def test_a_disk_that_is_full_for_a_while_costs_nothing(video, calm, tmp_path):
    try:
        with chaos.small_disk(tmp_path / "disk"):
            pass
    except OSError as error:
        pytest.skip(f"{error}: needs root")
    assert_kept(video, calm, [chaos.FULL])


def assert_kept(video, calm, faults, lockstep=True):
    """One run through the faults has one track a frame, and each message in the trees once; the object is followed."""
    path, boxes = video
    run = chaos.endure(path, {chaos.FIRST: boxes[0]}, Settings(run={"lockstep": lockstep}), faults)
    kept(run, len(boxes))
    truth = np.array(boxes)
    with_faults, without = (score(chaos.found(tracks, chaos.FIRST), truth).success for tracks in (run.tracks, calm[0]))
    assert with_faults > without - 0.05


def kept(run, frames):
    numbers = [{track.frame for track in tracks.values()} for tracks in run.tracks]
    assert numbers == [{frame} for frame in range(frames)]
    kept = dict(zip(chaos.KEPT, chaos.kept(run, frames), strict=True))
    assert not any(kept[f"{what} {how}"] for what in ("frames", "rows") for how in ("lost", "twice")), kept
    assert run.totals["sent"] == run.totals["stored"] == run.learned.seq == frames


def test_three_objects_that_begin_and_end_between_faults_lose_no_frame_and_no_row(video):
    path, truth = video
    boxes = sequences.objects(path, truth[0], 3)
    faults = ["kill -9 all three", "kill -9 compressor", "kill -9 detector", "kill -9 trainer"]
    run = chaos.endure(path, boxes, Settings(run={"lockstep": True}), faults)
    kept(run, len(truth))
    assert {change.box is None for change in run.changes} == {True, False}, "an object is forgotten, and one begins"
    assert all(chaos.FIRST in tracks for tracks in run.tracks)


@pytest.mark.slow
def test_forty_random_faults_cost_a_real_sequence_no_success():
    options = table.command("").parse_args([])
    if not options.data.is_dir():
        pytest.skip(f"no real sequences at {options.data}: put some there, or set TRACKING_DATA")
    source, truth = chaos.long(sequences.named(options, "TLD_01_david"), 600)
    boxes = {chaos.FIRST: Box(*map(float, truth[0]))}
    calm, _ = chaos.undisturbed(source, boxes)
    run = chaos.endure(source, boxes, Settings(), chaos.schedule(40, seed=1))
    assert (run.totals["sent"], run.totals["stored"]) == (len(truth), len(truth))
    with_faults, without = (score(chaos.found(tracks, chaos.FIRST), truth).success for tracks in (run.tracks, calm))
    assert with_faults > without - 0.02

"""Under every fault no frame and no row is lost or repeated: real processes, disks and clocks."""

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
        [chaos.FULL],
    ],
    ids=", ".join,
)
def test_no_frame_and_no_row_is_lost_or_repeated(video, calm, tmp_path, faults, lockstep):
    if chaos.FULL in faults:
        try:
            with chaos.small_disk(tmp_path / "disk"):
                pass
        except OSError as error:
            pytest.skip(f"{error}: needs root")
    path, boxes = video
    run = chaos.endure(path, {chaos.FIRST: boxes[0]}, Settings(run={"lockstep": lockstep}), faults)
    assert_whole(run, len(boxes))
    truth = np.array(boxes)
    with_faults, without = (score(chaos.found(tracks, chaos.FIRST), truth).success for tracks in (run.tracks, calm[0]))
    assert with_faults > without - 0.05


def assert_whole(run, frames):
    """Each frame has its tracks once, and each message is in the trees once."""
    numbers = [{track.frame for track in tracks.values()} for tracks in run.tracks]
    assert numbers == [{frame} for frame in range(frames)]
    counts = dict(zip(chaos.KEPT, chaos.kept(run, frames), strict=True))
    assert not any(counts[f"{each} {how}"] for each in ("frames", "rows") for how in ("lost", "twice")), counts
    assert run.totals["sent"] == run.totals["stored"] == run.learned.seq == frames


def test_objects_that_begin_and_end_between_faults_are_whole(video):
    path, truth = video
    boxes = sequences.objects(path, truth[0], 3)
    faults = ["kill -9 all three", "kill -9 compressor", "kill -9 detector", "kill -9 trainer"]
    run = chaos.endure(path, boxes, Settings(run={"lockstep": True}), faults)
    assert_whole(run, len(truth))
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

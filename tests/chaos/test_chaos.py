"""Under every fault nothing is lost and nothing comes twice: real processes, links, disks and clocks."""

from __future__ import annotations

import arena
import chaos
import pytest
import sequences
import table

from catstream.applications.evaluation.scores import score
from catstream.box import Box
from catstream.settings import Settings

pytestmark = pytest.mark.system


@pytest.mark.parametrize(
    "faults",
    [
        ["kill -9 all three", "link cut", "kill -9 detector"],
        ["kill -9 compressor", "clock jump", "SIGSTOP, SIGCONT", "link slow", "kill -9 trainer"],
    ],
    ids=", ".join,
)
def test_in_lockstep_all_is_as_without_faults_bit_for_bit(video, calm, faults):
    assert_same(video, calm, faults)


def test_a_disk_that_is_full_for_a_while_costs_nothing(video, calm, tmp_path):
    try:
        with arena.small_disk(tmp_path / "disk"):
            pass
    except OSError as error:
        pytest.skip(f"{error}: needs root")
    assert_same(video, calm, [chaos.FULL])


def assert_same(video, calm, faults):
    """One run through the faults stores what it sent, and learns what the tracker learned."""
    path, boxes = video
    run = chaos.endure(path, {chaos.FIRST: boxes[0]}, Settings(run={"lockstep": True}), faults)
    assert (run.totals["sent"], run.totals["stored"]) == (len(boxes), len(boxes))
    assert chaos.identical(run, calm)


def test_three_objects_that_begin_and_are_forgotten_between_faults_are_as_without_faults_bit_for_bit(video):
    path, truth = video
    boxes = sequences.objects(path, truth[0], 3)
    faults = ["kill -9 all three", "link cut", "kill -9 compressor", "kill -9 detector", "kill -9 trainer"]
    run = chaos.endure(path, boxes, Settings(run={"lockstep": True}), faults)
    assert (run.totals["sent"], run.totals["stored"]) == (len(truth), len(truth))
    assert {change.box is None for change in run.changes} == {True, False}, "an object is forgotten, and one begins"
    assert chaos.identical(run, chaos.undisturbed(path, boxes, run.changes))


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

"""Evaluation of annotation: boxes come from the ground truth, in the frames that are asked for."""

import json
from dataclasses import replace

import numpy as np
import pytest

from catstream.base.settings import Settings
from catstream.errors import CatstreamError
from catstream.evaluation.keyframes import KeyframeRow, boxes_until_complete, evaluate_keyframes, mean_by_boxes


@pytest.fixture(scope="module")
def rows(walk):
    from catstream.evaluation.datasets import find_sequences

    return evaluate_keyframes(find_sequences(walk), 3, Settings())


def test_there_is_a_row_for_each_number_of_boxes(rows):
    assert [(row.name, row.boxes) for row in rows] == [("walk", 1), ("walk", 2), ("walk", 3)]
    assert all(0 <= share <= 1 for row in rows for share in (row.success, row.checked, row.expected, row.forward))


def test_one_box_checks_its_own_frame_only(rows):
    assert rows[0].checked == pytest.approx(1 / 12)
    assert rows[0].precision is None


def test_interpolation_of_one_box_is_that_box(rows, sequence):
    first = np.tile(sequence.boxes[0], (12, 1))
    present = np.isfinite(sequence.boxes[:, 0])
    from catstream.evaluation.scores import overlaps

    assert rows[0].interpolation == (overlaps(first, sequence.boxes)[present] > 0.5).sum() / 12


def test_the_mean_leaves_out_sequences_without_the_measure(rows):
    (mean, *_) = mean_by_boxes([rows[0], replace(rows[0], success=0.0, precision=0.5)])
    assert mean.success == rows[0].success / 2
    assert mean.precision == 0.5


def test_a_sequence_is_complete_from_the_first_number_of_boxes():
    def row(name, boxes, complete):
        return KeyframeRow(name, boxes, 1.0, 1.0, None, 1.0, complete, 0.0, 0.0)

    rows = [row("a", 1, 0.0), row("a", 2, 1.0), row("a", 3, 1.0), row("b", 1, 0.0)]
    assert boxes_until_complete(rows) == {"a": 2, "b": None}


def test_a_sequence_that_fails_does_not_end_the_others(sequence, tmp_path):
    broken, errors = replace(sequence, name="broken", path=tmp_path), []
    rows = evaluate_keyframes([broken, sequence], 1, Settings(), failed=errors.append)
    assert [row.name for row in rows] == ["walk"]
    assert str(errors[0]).startswith("broken: ")
    with pytest.raises(CatstreamError, match="broken"):
        evaluate_keyframes([broken], 1, Settings())


def test_the_command_prints_the_means_and_writes_all_rows(walk, succeed, tmp_path):
    output, _ = succeed("evaluate", walk, "--keyframes", 2, "--json", tmp_path / "all.json")
    assert "boxes  success  checked  of these right" in output
    assert "of 1 sequence complete" in output
    assert [row["boxes"] for row in json.loads((tmp_path / "all.json").read_text())["rows"]] == [1, 2]


def test_keyframes_and_other_ways_to_start_are_mutually_exclusive(walk, fail):
    assert "--keyframes are mutually exclusive" in fail("evaluate", walk, "--keyframes", 2, "--jitter", 3)
    assert "mutually exclusive" in fail("evaluate", walk, "--keyframes", 2, "--tracker", "mil")

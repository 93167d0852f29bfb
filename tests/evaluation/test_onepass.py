"""One-pass evaluation: what is run, kept, found again, refused, and interrupted."""

import os
import re
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import psutil
import pytest

from catstream.base.settings import Settings
from catstream.errors import CatstreamError, SettingsError
from catstream.evaluation import onepass, runs
from catstream.evaluation.accuracy import describe_flips, flips_of, mean_of, rows_of
from catstream.evaluation.datasets import FIRST, Sequence, Start, jittered, spatial, temporal
from catstream.evaluation.onepass import evaluate, follow
from catstream.evaluation.runs import EvaluationRun, load, save

SETTINGS = Settings()


@pytest.fixture
def run(sequence, found) -> EvaluationRun:
    found[0], found[9] = sequence.boxes[0], np.nan
    confidence, seconds = np.linspace(1, 0.5, len(sequence)).round(6), np.full(len(sequence), 0.02)
    return EvaluationRun("catstream", sequence, FIRST, found.round(4), confidence, seconds)


@pytest.fixture
def counted(monkeypatch, found):
    """`follow`, without following: counts its calls."""
    calls = []

    def instead(tracker, _, sequence, start, *_models):
        calls.append((tracker, sequence.name + start.suffix))
        frames, boxes = len(sequence) - start.frame, found[start.frame :].round(4)
        boxes[0] = np.round(start.box(sequence), 4)
        return EvaluationRun(tracker, sequence, start, boxes, np.ones(frames), np.full(frames, 0.01))

    monkeypatch.setattr(onepass, "follow", instead)
    return calls


def test_each_tracker_starts_with_the_given_box_and_has_a_row_for_every_frame(sequence):
    for tracker in ("catstream", "mil"):
        run = follow(tracker, SETTINGS, sequence)
        assert run.boxes.shape == (12, 4)
        np.testing.assert_allclose(run.boxes[0], sequence.boxes[0], atol=1)
        assert np.isfinite(run.confidence).all()
        assert (run.seconds > 0).all()
        assert run.score().auc > 0.3  # MIL is random, and no seed of OpenCV's repeats a run
        assert run.fps > 0
    run = follow("catstream", SETTINGS, sequence, Start(8))
    assert run.name == "walk@8"
    assert run.boxes.shape == run.truth.shape == (4, 4)
    np.testing.assert_allclose(run.boxes[0], sequence.boxes[8], atol=1e-3)


@pytest.fixture
def longer(sequence) -> Sequence:
    """It has more boxes than frames."""
    return Sequence("longer", sequence.path, np.vstack([sequence.boxes, sequence.boxes[:1]]))


def test_processes_give_the_same_runs_as_one_and_name_a_sequence_that_fails(sequence, longer, tmp_path):
    errors: list[CatstreamError] = []
    given = {"starts": temporal(2), "output": tmp_path, "failed": errors.append}
    alone = evaluate([sequence], ["catstream"], SETTINGS, starts=temporal(2))
    pooled = evaluate([longer, sequence], ["catstream"], SETTINGS, jobs=2, **given)
    assert {str(error).partition(":")[0] for error in errors} == {"catstream on longer", "catstream on longer@8"}
    for one, other in zip(alone, pooled, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.boxes, other.boxes)
        np.testing.assert_array_equal(one.confidence, other.confidence)


def test_a_saved_run_has_the_layouts_of_the_toolkits_and_is_loaded_unchanged(tmp_path, run):
    """got10k's ExperimentOTB loads TRACKER/NAME.txt with np.loadtxt; the VOT toolkit parses lines of NAME_001.txt."""
    save(tmp_path, run)
    again = load(tmp_path, "catstream", run.sequence, FIRST)
    assert again is not None
    for field in ("boxes", "confidence", "seconds"):
        np.testing.assert_array_equal(getattr(again, field), getattr(run, field))
    home = tmp_path / "catstream"
    assert np.loadtxt(home / "walk.txt", delimiter=",").shape == (12, 4)
    assert np.loadtxt(home / "times" / "walk_time.txt").shape == (12,)
    vot = home / "longterm" / "walk"
    assert (vot / "walk_001.txt").read_text().splitlines()[9] == "nan,nan,nan,nan"
    assert len((vot / "walk_001_confidence.value").read_text().splitlines()) == 12
    assert len((vot / "walk_001_time.value").read_text().splitlines()) == 12
    (vot / "walk_001.txt").write_text("rubbish\n")
    with pytest.raises(CatstreamError, match="longterm/walk"):
        load(tmp_path, "catstream", run.sequence, FIRST)


def test_complete_runs_are_not_repeated(tmp_path, sequence, counted):
    first = evaluate([sequence], ["catstream", "mil", "mil"], SETTINGS, starts=temporal(2), output=str(tmp_path))
    assert len(counted) == len(first) == 4
    again = evaluate([sequence], ["catstream", "mil"], SETTINGS, starts=temporal(4), output=tmp_path)
    assert len(again) == 8
    assert counted[4:] == [("catstream", "walk@3"), ("catstream", "walk@9"), ("mil", "walk@3"), ("mil", "walk@9")]


def test_runs_from_changed_first_boxes_are_stored_beside_the_others(tmp_path, sequence, counted):
    evaluate([sequence], ["mil"], SETTINGS, output=tmp_path)
    for _ in range(2):
        shifted = evaluate([sequence], ["mil"], SETTINGS, starts=spatial, output=tmp_path)
        evaluate([sequence], ["mil"], SETTINGS, starts=jittered(3), output=tmp_path)
    assert len(shifted) == 12
    assert len(counted) == len(set(counted)) == 1 + 12 + 2  # the first of the jittered boxes is that of the plain run
    assert {path.name for path in (tmp_path / "mil" / "longterm").iterdir()} == {name for _, name in counted}


@pytest.mark.parametrize(
    "changed", [lambda boxes: boxes[:-1], lambda boxes: boxes + 3], ids=["fewer boxes", "another first box"]
)
def test_runs_with_another_ground_truth_are_repeated(tmp_path, sequence, counted, changed):
    for boxes in (sequence.boxes, changed(sequence.boxes)):
        evaluate([replace(sequence, boxes=boxes)], ["catstream"], SETTINGS, output=tmp_path)
    assert len(counted) == 2


def test_an_incomplete_run_is_repeated(tmp_path, sequence, run, counted):
    save(tmp_path, run)
    folder, part = tmp_path / "catstream" / "longterm" / "walk", tmp_path / "catstream" / "walk.part"
    part.mkdir()
    folder.rename(part / "walk")
    evaluate([sequence], ["catstream"], SETTINGS, output=tmp_path)
    assert len(counted) == 1
    assert not part.exists()


@pytest.mark.parametrize(
    ("version", "settings", "named"),
    [("3.0", SETTINGS, r"versions \(opencv\)"), (runs.OPENCV, Settings(coreset={"size": 32}), r"coreset\.size")],
)
def test_runs_of_another_version_or_with_other_settings_are_not_mixed_in(
    tmp_path, monkeypatch, sequence, counted, version, settings, named
):
    evaluate([sequence], ["catstream"], SETTINGS, output=tmp_path)
    monkeypatch.setattr(runs, "OPENCV", version)
    with pytest.raises(SettingsError, match=named):
        evaluate([sequence], ["catstream"], settings, output=tmp_path)
    assert len(counted) == 1


def test_a_moved_first_box_is_found_again_and_a_different_one_is_not(tmp_path, sequence):
    border = Sequence("border", sequence.path, sequence.boxes - sequence.boxes[0] + (-29, 40, 60, 60))
    (left, *_), right = spatial(border), spatial(border)[1]
    run = follow("mil", SETTINGS, border, left)
    assert run.boxes[0].tolist() == [-30, 40, 60, 60]  # its centre would be at -5
    save(tmp_path, run)
    assert load(tmp_path, "mil", border, left) is not None
    save(tmp_path, replace(run, start=right))
    assert load(tmp_path, "mil", border, right) is None


@pytest.mark.parametrize(
    ("count", "trackers", "message"),
    [
        (1, ["catstream", "kfc"], "unknown tracker 'kfc'"),
        (2, ["catstream"], "duplicate sequence name 'walk'"),
        (1, [], "missing tracker"),
    ],
)
def test_unknown_trackers_and_equal_names_are_errors_before_the_first_run(sequence, counted, count, trackers, message):
    with pytest.raises(CatstreamError, match=message):
        evaluate([sequence] * count, trackers, SETTINGS)
    assert not counted


def test_a_failing_sequence_is_named_and_the_others_run(tmp_path, sequence, longer):
    errors: list[CatstreamError] = []
    found = evaluate([longer, sequence], ["mil"], SETTINGS, output=tmp_path, failed=errors.append)
    assert [run.name for run in found] == ["walk"]
    assert load(tmp_path, "mil", sequence, FIRST) is not None
    (error,) = errors
    assert re.match(r"mil on longer: .* fewer frames than boxes", str(error))
    with pytest.raises(CatstreamError, match=r"mil on longer: .* fewer frames"):  # without a handler
        evaluate([longer], ["mil"], SETTINGS)


def test_a_killed_evaluation_leaves_no_worker(tmp_path, sequence):
    script = tmp_path / "killed.py"
    script.write_text(f"""
import signal
from catstream.evaluation.datasets import find_sequences, temporal
from catstream.evaluation.onepass import evaluate
from catstream.base.settings import Settings

def done(run):
    print("done", flush=True)
    signal.pause()

if __name__ == "__main__":
    evaluate(find_sequences({str(sequence.path)!r}), ["mil"], Settings(), starts=temporal(2), jobs=2, done=done)
""")
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        try:
            assert parent.stdout is not None
            assert parent.stdout.readline() == "done\n"
            workers = [child for child in psutil.Process(parent.pid).children() if "spawn_main" in str(child.cmdline())]
            assert workers
        finally:
            parent.kill()
    _, alive = psutil.wait_procs(workers, timeout=20)
    assert not alive


@pytest.mark.usefixtures("counted")
def test_rows_are_means_over_the_runs_with_their_spread(sequence):
    runs = evaluate([sequence], ["catstream", "mil"], SETTINGS, starts=temporal(2))
    rows = rows_of(runs)
    facts = [(row.name, row.tracker, row.frames, row.runs) for row in rows]
    assert facts == [("walk", "catstream", 12, 2), ("walk", "mil", 12, 2)]
    scores = [run.score().auc for run in runs[:2]]
    assert rows[0].auc == pytest.approx(np.mean(scores))
    assert rows[0].auc_spread == pytest.approx(np.std(scores))


def test_the_mean_f_score_is_over_the_sequences_that_have_one(sequence, run):
    whole = Sequence("whole", sequence.path, np.nan_to_num(sequence.boxes, nan=30.0))
    other = EvaluationRun("catstream", whole, FIRST, run.boxes, run.confidence, run.seconds)
    rows = rows_of([run, other])
    assert rows[1].f_score is None
    assert mean_of(rows)["catstream"]["f_score"] == rows[0].f_score
    assert mean_of(rows[1:])["catstream"]["f_score"] is None


def test_a_sequence_flips_if_its_success_depends_on_the_first_box(sequence, run):
    def with_success(kept: int, start: Start) -> EvaluationRun:
        boxes = np.where(np.arange(12)[:, None] < kept, sequence.boxes, np.nan)
        return replace(run, boxes=boxes[start.frame :], confidence=run.confidence[start.frame :], start=start)

    starts = jittered(2)(sequence)
    rows = rows_of(map(with_success, (12, 9), starts)) + rows_of(map(with_success, (12, 10), starts))
    assert [row.flips for row in rows] == [True, False]  # 9 of 12 frames have the object: 0.33 and 0.22 are lost
    assert flips_of(rows[:1]) == {"catstream": ["walk"]}
    said = "catstream: 0 of 1 sequences flip with the initial box (success differs by more than 0.25)"
    assert describe_flips(rows[1:]) == [said]
    assert flips_of(rows_of([with_success(3, start) for start in temporal(2)(sequence)])) == {}


def test_ctrl_c_while_the_workers_start_is_one_line_and_no_worker_is_left(walk, catstream, until, tmp_path):
    """The terminal sends it to all of them, of which the workers are at their imports."""
    runs = ["--starts", 4, "--jobs", 2, "--output", tmp_path / "out"]
    process = catstream("evaluate", walk, *runs, process_group=0)
    family = psutil.Process(process.pid)
    # Two workers, and the tracker of their resources.
    until(lambda: len(family.children()) >= 3 or process.poll() is not None)
    children = family.children()
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate()
    assert "Traceback" not in errors
    assert errors.splitlines()[-1].startswith("stopped: complete runs are in ")
    assert process.returncode == 130
    assert not psutil.wait_procs(children, timeout=10)[1]

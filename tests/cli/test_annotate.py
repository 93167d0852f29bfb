"""`catstream annotate`: its files, the frame to check next, and its errors."""

import csv
import json

import pytest

from catstream.base.files import locked_folder

FRAMES = 12


@pytest.fixture
def demo(demo_video):
    video, boxes = demo_video(FRAMES)
    return str(video), [",".join(map(str, box)) for box in boxes]


def rows(file):
    with file.open(newline="") as table:
        return list(csv.DictReader(table))


def test_annotation_continues_from_its_boxes(demo, succeed, tmp_path):
    video, boxes = demo
    out = tmp_path / "out"
    output, _ = succeed("annotate", video, "--box", f"anna@0={boxes[0]}", "--output", out, "--jobs", 1)
    assert f"anna: 1 of {FRAMES} frames checked (8%), 1 keyframe" in output
    assert f"look next at frame {FRAMES - 1} for anna" in output
    assert [row["frame"] for row in rows(out / "next.csv")] == [str(FRAMES - 1)]

    more = ("--boxes", out / "keyframes.csv", "--box", f"anna@{FRAMES - 1}={boxes[-1]}", "--output", out)
    output, _ = succeed("annotate", video, *more, "--overwrite", "--jobs", 1)
    assert "all frames are checked" in output
    assert rows(out / "next.csv") == []
    assert len(rows(out / "keyframes.csv")) == 2
    assert (out / "passes.safetensors").exists()
    log = rows(out / "demo.csv")
    assert [row["checked"] for row in log] == ["keyframe", *["checked"] * (FRAMES - 2), "keyframe"]
    assert all(0.97 <= float(row["probability"]) <= 1 for row in log)
    _, first, *_ = map(json.loads, (out / "demo.ndjson").read_text().splitlines())
    assert (first["checked"], first["doubtful"]) == ("keyframe", False)


def test_output_of_a_running_annotation_is_locked(demo, fail, tmp_path):
    video, boxes = demo
    with locked_folder(tmp_path / "out"):
        error = fail("annotate", video, "--box", f"@0={boxes[0]}", "--output", tmp_path / "out", "--overwrite")
    assert "out is being written by process" in error


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        (["anna@0=1,2,30,40", "anna@0=1,2,30,41"], "anna has two boxes in frame 0: pass one of them"),
        (["anna@99=1,2,30,40"], "anna: frame 99 is outside the video"),
        (["anna=1,2,30,40"], "expected NAME@FRAME=X,Y,W,H"),
    ],
)
def test_invalid_boxes_are_an_error(demo, fail, tmp_path, boxes, message):
    options = [word for box in boxes for word in ("--box", box)]
    assert message in fail("annotate", demo[0], *options, "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [["--box", "@0=1,2,30,40"], []], ids=["boxes", "page"])
def test_existing_results_are_replaced_only_on_request(demo, fail, tmp_path, options):
    (tmp_path / "demo.ndjson").touch()
    assert "demo.ndjson exists already" in fail("annotate", demo[0], *options, "--output", tmp_path)


def test_ctrl_c_keeps_the_boxes_and_the_finished_tracks(demo, said, tmp_path, monkeypatch):
    from catstream.offline.annotation import Annotation

    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Annotation, "track", interrupted)
    code, _, errors = said("annotate", demo[0], "--box", f"@0={demo[1][0]}", "--output", tmp_path / "out")
    assert (code, errors) == (130, f"stopped: the results so far are in {tmp_path / 'out'}\n")
    assert len(rows(tmp_path / "out" / "keyframes.csv")) == 1
    assert len(rows(tmp_path / "out" / "demo.csv")) == FRAMES


def test_ctrl_c_before_the_first_box_writes_no_log(demo, said, tmp_path, monkeypatch):
    monkeypatch.setattr("catstream.cli.annotate.serve", lambda *_: True)
    code, output, errors = said("annotate", demo[0], "--output", tmp_path)
    assert (code, output, errors) == (130, "no box was drawn\n", "stopped\n")
    assert [file.name for file in tmp_path.iterdir()] == ["keyframes.csv"]

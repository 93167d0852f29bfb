"""Annotation of a rendered video: passes, checked frames, and the next frame to label."""

import multiprocessing
import shutil
from pathlib import Path

import pytest

from catstream.errors import BoxError, ObjectError, VideoError
from catstream.offline import annotation as module
from catstream.offline import passes
from catstream.offline.annotation import Annotation, annotate

FRAMES = 24


@pytest.fixture(scope="module")
def video(demo_video):
    return demo_video(FRAMES)[0]


@pytest.fixture(scope="module")
def truth(demo_video):
    return demo_video(FRAMES)[1]


@pytest.fixture(scope="module")
def both_ends(video, truth):
    """The annotation of the video with its object's boxes in the first and the last frame."""
    with annotate(video, {"anna": {0: truth[0], FRAMES - 1: truth[-1]}}, jobs=1) as annotation:
        yield annotation


def test_two_boxes_check_all_frames_of_an_easy_object(truth, both_ends):
    tracks = both_ends.tracks["anna"]
    assert all(track.box.overlap(box) > 0.5 for track, box in zip(tracks, truth, strict=True))
    assert [(track.frame, track.object) for track in tracks] == [(frame, "anna") for frame in range(FRAMES)]
    assert tracks[-1].time == both_ends.frames.times[-1] > 0
    assert [(tracks[end].box, tracks[end].probability) for end in (0, -1)] == [(truth[0], 1), (truth[-1], 1)]
    assert both_ends.checked["anna"] == ["keyframe", *["checked"] * (FRAMES - 2), "keyframe"]
    assert both_ends.share_checked == 1
    assert both_ends.next_frame() is None


def test_single_box_leaves_the_other_frames_unchecked(video, truth):
    with annotate(video, {3: truth[3]}, jobs=1) as annotation:
        assert all(track.box is not None for track in annotation.tracks[""])
        assert annotation.checked[""].count("unchecked") == FRAMES - 1
        assert annotation.next_frame().frame == FRAMES - 1
        assert {question.frame for question in annotation.next_frames()} == {0, FRAMES - 1}


def test_replaced_box_drops_the_passes_from_it(video, truth):
    wrong = truth[-1].centred(60, 60)
    with annotate(video, {0: truth[0], FRAMES - 1: wrong}, jobs=1) as annotation:
        before = annotation.passes()
        annotation.add(FRAMES - 1, truth[-1])
        assert {one.start for one in annotation.passes() if one in before} == {0}
        assert annotation.share_checked == 1


def test_two_processes_give_the_same_tracks_as_one(video, truth, both_ends):
    with annotate(video, {"anna": {0: truth[0], FRAMES - 1: truth[-1]}}, jobs=2) as annotation:
        assert [*annotation.tracks["anna"]] == [*both_ends.tracks["anna"]]
        processes = {*multiprocessing.active_children()}
        annotation.add(12, truth[12], "anna")
        assert {*multiprocessing.active_children()} == processes
    assert not multiprocessing.active_children()


def test_absent_object_has_no_box(video, truth):
    with annotate(video, {0: truth[0], FRAMES - 1: None}, jobs=1) as annotation:
        assert annotation.tracks[""][-1].state == "absent"
        annotation.add(FRAMES - 1, truth[-1])
        assert annotation.tracks[""][-1].box == truth[-1]


def test_hidden_object_keeps_its_estimated_box(video, truth):
    with annotate(video, {0: truth[0]}, jobs=1) as annotation:
        passes, tracks = annotation.passes(), annotation.tracks[""]
        asked = []
        for _ in range(3):
            asked.append(annotation.next_frame().frame)
            annotation.add(asked[-1], "hidden")
        assert len({*asked}) == 3
        assert annotation.passes() == passes
        assert [track.box for track in annotation.tracks[""]] == [track.box for track in tracks]
        assert [annotation.checked[""][frame] for frame in (0, *asked)] == ["keyframe", *["hidden"] * 3]


def test_finished_passes_remain_after_ctrl_c(video, truth, monkeypatch):
    work, started = module._work, []

    def interrupted(*task):
        started.append(task)
        if len(started) == 2:
            raise KeyboardInterrupt
        return work(*task)

    monkeypatch.setattr(module, "_work", interrupted)
    with Annotation(video, {0: truth[0], FRAMES - 1: truth[-1]}, jobs=1) as annotation:
        with pytest.raises(KeyboardInterrupt):
            annotation.track()
        assert len(annotation.passes()) == 1
        assert annotation.tracks[""][5].box is not None
        annotation.track()
        assert len(annotation.passes()) == 2


def test_no_file_remains_and_none_holds_the_frames(video, truth, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with annotate(video, {0: truth[0], FRAMES - 1: truth[-1]}, jobs=1) as annotation:
        sizes = [file.stat().st_size for file in tmp_path.rglob("*") if file.is_file()]
        assert sum(sizes) < annotation.frames[0].nbytes
    with pytest.raises(BoxError):
        annotate(video, {99: truth[0]})
    assert not [*tmp_path.iterdir()]


def test_the_frames_before_damage_that_a_pass_meets_are_tracked(walk, tmp_path):
    images = shutil.copytree(walk / "img", tmp_path / "img")
    (images / "0006.png").write_bytes(b"no image")
    with Annotation(images, {0: (20, 20, 30, 30)}, jobs=1) as annotation:
        with pytest.raises(VideoError, match=r"^5 frames could be read: .*0006\.png"):
            annotation.track()
        annotation.track()
        assert len(annotation.tracks[""]) == 5


@pytest.mark.parametrize(
    ("boxes", "error", "message"),
    [
        ({FRAMES: (1, 2, 30, 40)}, BoxError, "frame 24 is outside the video: pass a frame from 0 to 23"),
        ({"anna": {0: (400, 2, 30, 40)}}, BoxError, "anna: the box .* outside the frame"),
        ({"anna": {0: None}}, ObjectError, "anna has no box"),
        ({}, ObjectError, "no object"),
        ({"a b": {0: (1, 2, 30, 40)}}, ObjectError, "not a name"),
    ],
)
def test_invalid_boxes_are_an_error(video, boxes, error, message):
    with pytest.raises(error, match=message):
        annotate(video, boxes)


def test_live_source_is_an_error(truth):
    with pytest.raises(VideoError, match="a live source"):
        annotate("rtsp://10.0.0.7/stream", {0: truth[0]})


def test_stored_passes_serve_the_same_video_and_settings(video, truth, both_ends, tmp_path):
    both_ends.stored = tmp_path / "passes"
    both_ends.save_passes()
    boxes = {"ben": {0: truth[0], FRAMES - 1: truth[-1]}}

    def missing(video=video, boxes=boxes, settings=None):
        with Annotation(video, boxes, settings) as annotation:
            annotation.stored = tmp_path / "passes"
            annotation.scan()
            return len(annotation.missing()), annotation.passes("ben")

    count, stored = missing()
    assert count == 0
    for one, other in zip(stored, both_ends.passes("anna"), strict=True):
        assert (one.start, one.stop) == (other.start, other.stop)
        assert (one.boxes.tobytes(), one.scores.tobytes()) == (other.boxes.tobytes(), other.scores.tobytes())
    assert missing(boxes={"ben": {0: truth[0], 12: truth[12], FRAMES - 1: truth[-1]}})[0] == 2
    assert missing(settings={"coreset.size": 20})[0] == 2
    assert missing(video=shutil.copy(video, tmp_path))[0] == 2  # it was written at another time
    (tmp_path / "passes").write_bytes(b"damaged")
    assert missing()[0] == 2


def test_paused_pass_waits(video, monkeypatch):
    waits = []
    with Annotation(video, {}) as annotation:
        folder = Path(annotation._folder.name)
        with annotation.paused():
            monkeypatch.setattr(passes.time, "sleep", lambda _: waits.append((folder / passes.PAUSED).unlink()))
            images = [*passes._images(annotation.frames, [0], folder, None)]
        assert (len(images), len(waits)) == (1, 1)

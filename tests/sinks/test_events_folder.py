"""A picture of each event in a folder, of which the oldest are removed."""

from contextlib import ExitStack, closing, contextmanager
from functools import partial

import cv2
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.client.address import Address
from catstream.errors import VideoError
from catstream.jobs.job import SinkOptions
from catstream.messages.kinds import Preview, Track
from catstream.sinks import remote
from catstream.sinks.destinations import Origin, TrackedFrame, check_sink, open_sink
from catstream.wire.channels import PREVIEWS
from catstream.wire.newest import Publisher

BOX = Box(40, 60, 200, 100)


@pytest.fixture
def image(rng):
    return cv2.imencode(".jpg", rng.integers(0, 255, (120, 160, 3), np.uint8))[1].tobytes()


def frame(number, box=BOX):
    return TrackedFrame([Track(number, number / 10, "absent" if box is None else "present", box, 0.9, 1, None, "anna")])


@contextmanager
def writing(folder, endpoint, until, **options):
    """A sink that receives the pictures of the publisher that is yielded, too."""
    options = SinkOptions(folder=folder, **options)
    with ExitStack() as stack:
        previews = stack.enter_context(Publisher(PREVIEWS, endpoint))
        origin = Origin(address=Address(str(endpoint)), options=options)
        sink = stack.enter_context(closing(open_sink(*options.places, origin)))
        until(lambda: previews.has_subscribers, previews.serve_late_joiners)
        yield sink, previews


def kinds(folder):
    """Events and objects of the pictures, oldest first."""
    return [file.stem.split("-", 1)[1] for file in sorted(folder.glob("2*.jpg"))]


def test_each_event_has_a_picture_of_its_frame_or_a_later_one(tmp_path, endpoint, until, image):
    with writing(tmp_path / "new", endpoint, until, events=("found", "lost")) as (sink, previews):
        sink.write(frame(0))
        previews.send(Preview(0, 0.0, 640, 480, {"anna": BOX}, image))
        until(lambda: kinds(tmp_path / "new"), lambda: sink.write(frame(0)))
        sink.write(frame(30, None))
        assert kinds(tmp_path / "new") == ["found-anna"], "the picture of frame 0 is older than the event"
        previews.send(Preview(31, 3.1, 640, 480, {}, image))
        until(lambda: len(kinds(tmp_path / "new")) == 2, lambda: sink.write(frame(31, None)))
    assert kinds(tmp_path / "new") == ["found-anna", "lost-anna"]
    found = cv2.imread(str(min((tmp_path / "new").iterdir())))
    assert found.shape[:2] > (120, 160), "with a line of text"
    assert len(np.unique(found[12:16, 12:58].reshape(-1, 3), axis=0)) < 46 * 4, "and the box"


def test_the_oldest_pictures_are_removed_and_other_files_stay(tmp_path, endpoint, until, image):
    (tmp_path / "20200101T000000.000Z-found-ben.jpg").write_bytes(image)
    (tmp_path / "holiday.jpg").write_bytes(image)
    chosen = {"events": ("found", "lost", "returned"), "folder_megabytes": 4 * len(image) / 1e6}
    with writing(tmp_path, endpoint, until, **chosen) as (sink, previews):
        for number, kind in enumerate(["found", "lost", "returned", "lost", "returned", "lost"]):
            previews.send(Preview(100 * number, 10.0 * number, 640, 480, {}, image))
            again = partial(sink.write, frame(100 * number, None if kind == "lost" else BOX))
            until(lambda name=f"{kind}-anna": kinds(tmp_path)[-1] == name, again)
    assert (tmp_path / "holiday.jpg").exists()
    assert kinds(tmp_path)[-2:] == ["returned-anna", "lost-anna"]
    assert sum(file.stat().st_size for file in tmp_path.glob("2*.jpg")) <= 4 * len(image)


def test_if_frames_stop_an_event_has_the_last_picture(tmp_path, endpoint, until, image, monkeypatch):
    monkeypatch.setattr(remote, "_PICTURE_SECONDS", 0.1)
    with writing(tmp_path, endpoint, until) as (sink, previews):
        previews.send(Preview(0, 0.0, 640, 480, {}, image))
        until(lambda: kinds(tmp_path) == ["found-anna"], partial(sink.write, frame(0)))
        sink.write(frame(30, None))
        until(lambda: kinds(tmp_path) == ["found-anna", "lost-anna"], sink.idle)


def test_a_folder_that_cannot_be_made_is_an_error_before_the_run(tmp_path):
    (tmp_path / "file").touch()
    options = SinkOptions(folder=tmp_path / "file" / "events")
    with pytest.raises(VideoError, match=r"cannot make the folder .*: Not a directory"):
        check_sink(*options.places, options)


def test_a_run_writes_pictures_of_its_events(demo_video, tmp_path, succeed):
    video, boxes = demo_video(32)
    options = ("--events-folder", tmp_path, "--zone", "all=0,0 320,0 320,240 0,240")
    succeed("track", video, "--box", f"flower={boxes[0]}", *options)
    found, *others = kinds(tmp_path)
    assert (found, others) == ("found-flower", ["entered-flower-all", "left-flower-all", "ended-flower"])

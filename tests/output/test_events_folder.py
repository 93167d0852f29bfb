"""A picture of each event in a folder, of which the oldest are removed."""

import json
from contextlib import ExitStack, closing, contextmanager
from functools import partial

import cv2
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.client.address import Address
from catstream.errors import VideoError
from catstream.output import events_folder, remote
from catstream.output.destinations import Origin, SinkOptions, TrackedFrame, check_sink, open_sink
from catstream.wire.channels import PREVIEWS
from catstream.wire.messages import Preview, Track
from catstream.wire.newest import Publisher

BOX = Box(40, 60, 200, 100)


@pytest.fixture
def image(rng):
    return cv2.imencode(".jpg", rng.integers(0, 255, (120, 160, 3), np.uint8))[1].tobytes()


def frame(number, box=BOX):
    return TrackedFrame([Track(number, number / 10, "absent" if box is None else "present", box, 0.9, 1, None, "anna")])


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """Wait for the picture of an event on a busy machine."""
    monkeypatch.setattr(remote, "_PICTURE_SECONDS", 60.0)


@contextmanager
def writing(folder, endpoint, until, **options):
    """Opens a sink that receives the pictures of a publisher; yields both."""
    with ExitStack() as stack:
        previews = stack.enter_context(Publisher(PREVIEWS, endpoint))
        origin = Origin(address=Address(str(endpoint)), options=SinkOptions(**options))
        sink = stack.enter_context(closing(open_sink(f"{folder}/", origin)))
        until(lambda: previews.has_subscribers, previews.serve_late_joiners)
        yield sink, previews


def kinds(folder):
    """Events and objects of the pictures, oldest first."""
    return [file.stem.split("-", 1)[1] for file in sorted(folder.glob("2*.jpg"))]


def test_event_has_a_picture_of_its_frame_or_a_later_one(tmp_path, endpoint, until, image):
    with writing(tmp_path / "new", endpoint, until, when={"found": 0.0, "lost": 2.0}) as (sink, previews):
        sink.write(frame(0))
        previews.send(Preview(0, 0.0, 640, 480, {"anna": BOX}, image))
        until(lambda: kinds(tmp_path / "new"), lambda: sink.write(frame(0)))
        sink.write(frame(30, None))
        assert kinds(tmp_path / "new") == ["found-anna"], "the picture of frame 0 is older than the event"
        previews.send(Preview(31, 3.1, 640, 480, {}, image))
        until(lambda: len(kinds(tmp_path / "new")) == 2, lambda: sink.write(frame(31, None)))
    assert kinds(tmp_path / "new") == ["found-anna", "lost-anna"]
    found = cv2.imread(str(min((tmp_path / "new").glob("2*.jpg"))))
    assert found.shape[:2] > (120, 160), "with a line of text"
    assert len(np.unique(found[12:16, 12:58].reshape(-1, 3), axis=0)) < 46 * 4, "and the box"


def test_oldest_pictures_are_removed_and_other_files_stay(tmp_path, endpoint, until, image):
    (tmp_path / "20200101T000000.000Z-found-ben.jpg").write_bytes(image)
    (tmp_path / "holiday.jpg").write_bytes(image)
    chosen = {"when": {"found": 0.0, "lost": 2.0, "returned": 0.0}, "megabytes": 4 * len(image) / 1e6}
    with writing(tmp_path, endpoint, until, **chosen) as (sink, previews):
        for number, kind in enumerate(["found", "lost", "returned", "lost", "returned", "lost"]):
            previews.send(Preview(100 * number, 10.0 * number, 640, 480, {}, image))
            again = partial(sink.write, frame(100 * number, None if kind == "lost" else BOX))
            until(lambda name=f"{kind}-anna": kinds(tmp_path)[-1] == name, again)
    assert (tmp_path / "holiday.jpg").exists()
    assert kinds(tmp_path)[-2:] == ["returned-anna", "lost-anna"]
    assert sum(file.stat().st_size for file in tmp_path.glob("2*.jpg")) <= 4 * len(image)


def test_folder_that_cannot_be_made_is_an_error_before_the_run(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(VideoError, match=r"cannot create the folder .*: Not a directory"):
        check_sink(f"{tmp_path}/file/events/", SinkOptions())


def test_event_is_a_line_of_json_which_names_its_picture(tmp_path, endpoint, until, image, monkeypatch):
    monkeypatch.setattr(events_folder, "_LOG_BYTES", 1)
    with writing(tmp_path, endpoint, until) as (sink, previews):
        previews.send(Preview(0, 0.0, 640, 480, {}, image))
        until(lambda: kinds(tmp_path) == ["found-anna"], partial(sink.write, frame(0)))
        (first,) = (tmp_path / "events.1.ndjson").read_text().splitlines()
        monkeypatch.setattr(events_folder, "_LOG_BYTES", 1 << 20)
    last = json.loads((tmp_path / "events.ndjson").read_text())
    assert json.loads(first)["picture"] == min(tmp_path.glob("*-found-anna.jpg")).name
    assert (last["event"], last["object"], last["picture"]) == ("ended", "anna", max(tmp_path.glob("2*.jpg")).name)

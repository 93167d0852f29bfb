"""The objects that begin in a frame: by the job, by commands, and by a resume."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from catstream.base.box import Box
from catstream.detection.objects import Detectors
from catstream.features.pyramid import Pyramid
from catstream.processes.commands import Commands
from catstream.processes.decisions import DesiredObject, DesiredState, Start
from catstream.processes.initialization import Initializer
from catstream.processes.job import Job
from catstream.processes.outputs import Previews
from catstream.processes.process import Process
from catstream.processes.state import DESIRED
from catstream.video.frames import Frame
from catstream.wire.messages import Command

BOX, OTHER = Box(60, 50, 48, 40), Box(10, 20, 30, 30)


class Stream:
    """The objects that begin in the frames of one image, of a run that has the box of anna."""

    def __init__(self, process, commands, detectors, previews, image):
        self.commands, self.detectors, self._image = commands, detectors, image
        self.initializer = Initializer(process, detectors, commands, previews)

    def frame(self, suspended=False):
        """The names of the objects that begin in the next frame; tracked if any begins or not suspended."""
        number, answers = self.detectors.seq, []
        self.commands.store_and_answer = lambda *answered: answers.extend(answered)
        objects = self.initializer.in_frame(Frame(number, number / 25, self._image), suspended=suspended)
        if objects or not suspended:
            results = {one.name: one.result for one in objects}
            self.detectors.step(Pyramid(self._image), number / 25, results)
        self.answers = [(answered.object, answered.done) for answered in answers]
        return [one.name for one in objects]


@pytest.fixture
def stream(folder, scene, monkeypatch):
    monkeypatch.setattr("signal.signal", lambda *_: None)  # the handlers of this process stay
    job = Job("walk.mp4", {"anna": BOX}, endpoint=str(folder), run="one")
    with closing(Process("detector", job)) as process:
        detectors = Detectors(process.settings)
        with Commands(process, detectors) as commands, Previews(process.endpoint) as previews:
            yield Stream(process, commands, detectors, previews, scene((60, 50)))


def set_box(number, name, box=OTHER, **more):
    return Command(number, "set-box", box, object=name, **more)


def test_object_of_the_job_begins_in_the_first_frame_only(stream):
    assert [stream.frame() for _ in range(3)] == [["anna"], [], []]


def test_objects_begin_in_a_paused_run_only_with_a_box(stream):
    assert stream.frame(suspended=True) == []
    stream.commands.boxes.append(set_box("1", "ben"))
    assert stream.frame(suspended=True) == ["ben", "anna"]


def test_second_box_for_one_name_waits_for_the_next_frame(stream):
    stream.frame()
    stream.commands.boxes += [set_box("1", "ben"), set_box("2", "ben", BOX), set_box("3", "carl")]
    assert stream.frame() == ["ben", "carl"]
    assert stream.answers == [("ben", True), ("carl", True)]
    assert stream.frame() == ["ben"]
    assert stream.commands.desired.objects["ben"] == DesiredObject(BOX, begins=3)


@pytest.mark.parametrize("box", [Box(900, 900, 20, 20), Box(10, 10, 1, 1)], ids=["outside", "too small"])
def test_invalid_box_is_rejected_and_begins_no_object(stream, box):
    stream.frame()
    stream.commands.boxes.append(set_box("1", "ben", box))
    assert stream.frame() == []
    assert stream.answers == [("ben", False)]
    assert list(stream.commands.desired.objects) == ["anna"]


def test_pause_with_a_limit_ends_by_itself(stream, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("catstream.processes.commands.monotonic", lambda: now[0])
    assert stream.commands._execute(Command("1", "pause", seconds=30.0)).done
    assert stream.commands.suspended
    now[0] += 31
    assert not stream.commands.suspended


def test_run_with_a_torn_state_resumes_with_its_first_boxes(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("signal.signal", lambda *_: None)  # the handlers of this process stay
    (tmp_path / DESIRED).write_text("{")
    job = Job("walk.mp4", {"anna": BOX}, endpoint=str(folder), run="one", state=tmp_path, resume=True)
    with closing(Process("detector", job)) as process, Commands(process, Detectors(process.settings)) as commands:
        assert commands.desired == DesiredState({"anna": DesiredObject(BOX, begins=1)})
        assert "cannot read the desired state" in process.trouble


def test_unwritable_desired_state_is_written_later(stream, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("catstream.processes.commands.monotonic", lambda: now[0])
    commands, process = stream.commands, stream.commands._process
    file = process.state / DESIRED
    file.unlink()
    file.mkdir()
    commands.change(replace(commands.desired, paused=True))
    assert process.trouble.startswith(f"cannot write '{file}' (Is a directory): ")
    file.rmdir()
    commands.execute()
    assert not file.exists(), "not in each iteration"
    now[0] += 5
    commands.execute()
    assert (DesiredState.load(file).paused, process.trouble) == (True, "")


def test_resumed_object_without_a_state_begins_again(stream):
    objects = {"anna": DesiredObject(BOX, begins=8), "ben": DesiredObject(OTHER, begins=20)}
    start = Start(7, 7, DesiredState(objects), {})
    stream.detectors.seq = start.seq
    stream.initializer.resume(start, {})
    stream.commands.resume(start)
    assert stream.frame() == ["anna", "ben"], "of ben nothing is there"
    assert stream.detectors.detectors["anna"].state.first_frame == 7
    assert np.isclose(stream.detectors.detectors["anna"].box.overlap(BOX), 1, atol=0.05)

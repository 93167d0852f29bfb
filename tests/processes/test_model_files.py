"""The files of saved models: they are read as they were written, and a damaged one is missing."""

import signal
import stat
from contextlib import ExitStack, closing

import pytest

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.multi import MultiTracker
from catstream.processes.detector import DetectorLoop
from catstream.processes.job import Job
from catstream.processes.model_files import ModelFiles
from catstream.processes.process import Process
from catstream.video.rendered import render
from catstream.wire.messages import Command


@pytest.fixture(scope="module")
def learned():
    tracker = MultiTracker({"coreset.size": 8})
    for number, (image, box) in enumerate(render(8, (160, 120))):
        if number:
            tracker.update(image)
        else:
            tracker.init(image, {"anna": box})
    return tracker.saved_model("anna")


def test_stored_model_is_private_and_read_by_its_name(learned, tmp_path):
    files = ModelFiles(tmp_path / "models")
    name = files.add(learned).model
    files.store()
    (file,) = (tmp_path / "models").iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert ModelFiles(tmp_path / "models").get(name).to_bytes() == learned.to_bytes()


def test_damaged_or_removed_model_is_missing(learned, tmp_path, caplog):
    files = ModelFiles(tmp_path)
    name = files.add(learned).model
    files.store()
    (tmp_path / f"{name}.safetensors").write_bytes(b"torn")
    assert ModelFiles(tmp_path).get(name) is None
    files.keep_only(set())
    assert list(tmp_path.iterdir()) == []
    assert files.get(name) is None
    assert "search for the object of a saved model was stopped" in caplog.text


@pytest.mark.parametrize("has_state", [True, False])
def test_model_of_a_rejected_search_is_not_stored(learned, folder, tmp_path, monkeypatch, has_state):
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # those of this process stay
    settings = Settings(coreset={"size": 8}, run={"max_objects": 1})
    state = tmp_path if has_state else None
    job = Job("walk.mp4", {"ben": Box(1, 2, 30, 40)}, settings=settings, endpoint=str(folder), state=state)
    with closing(Process("detector", job)) as process, ExitStack() as stack:
        loop = DetectorLoop(process, stack)
        command = Command("1", "search", object="anna", model=learned.to_bytes())
        loop.commands.store_and_answer(answer := loop.commands._execute(command))
        assert not answer.done
        assert list(loop.commands.desired.objects) == ["ben"]
        assert not loop.commands.models._models

"""A detector that crashes writes the last events of its core, which lead to the same actions again."""

from __future__ import annotations

import subprocess

import msgspec

from catstream.run.job import Job
from catstream.services.core import History, handle
from catstream.services.core_state import Phase
from catstream.services.start import environment, python_command
from catstream.settings import Settings

CRASHES = """
import sys
from pathlib import Path
from catstream.detection.objects import Detectors
from catstream.run.job import Job
from catstream.services.loop import run

step = Detectors.step
Detectors.step = lambda self, *given: 1 / 0 if self.seq == 5 else step(self, *given)
sys.exit(run("detector", Job.load(Path({file!r}))))
"""


def test_a_detector_that_crashes_writes_its_last_events_and_they_lead_to_the_same_actions_again(
    video, folder, tmp_path
):
    path, boxes = video
    job = Job(str(path), boxes={"anna": boxes[0]}, settings=Settings(), endpoint=str(folder), state=tmp_path)
    command = python_command(CRASHES.format(file=str(job.save(tmp_path))))
    crashed = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False, timeout=60)
    file = tmp_path / "detector_events.ndjson"
    assert "ZeroDivisionError" in crashed.stderr
    assert f"detector: the last events before this error are in {file}\n" in crashed.stderr
    state, steps = History.read(file)
    for event, orders in steps:
        state, found = handle(state, event)
        assert msgspec.json.decode(msgspec.json.encode(found)) == orders
    assert (state.phase, state.seq) == (Phase.STEP, 5), "it crashed in the sixth frame"
    assert not crashed.stdout
    assert crashed.returncode == 1

"""The end of a run reaches every receiver, after restarts and if the program is slow."""

import os
import signal
import time
from itertools import islice
from pathlib import Path

import pytest

from catstream.base.settings import Settings
from catstream.errors import VideoError
from catstream.pipeline import Pipeline
from catstream.processes.start_server import NAMES
from catstream.processes.supervisor import APART_SECONDS, Child


def test_source_that_fails_after_a_restart_ends_the_run(endless, video):
    """The compressor has stored nothing yet, so all frames that the program has are repeated."""
    settings = Settings(run={"checkpoint_seconds": 600.0})
    with Pipeline(endless, video[1][0], settings) as pipeline:
        tracks = list(islice(pipeline, 11))
        Path(endless, "00005.png").unlink()  # the others are links to the same image
        Path(endless, "00005.png").write_bytes(b"damaged meanwhile")
        for victim in ("detector", "compressor"):
            os.kill(pipeline.pids[victim], signal.SIGKILL)
        with pytest.raises(VideoError, match=r"00005\.png"):
            tracks.extend(pipeline)
        assert [track.frame for track in tracks] == list(range(len(tracks)))
        assert "00005.png" in pipeline.reason
        assert pipeline.totals["sent"] == pipeline.totals["stored"] == 5


def test_no_process_is_restarted_while_the_program_is_slow(video, monkeypatch):
    """The compressor and the trainer end as soon as all is stored, the detector once the program has all tracks."""
    start, started = Child.start, []
    monkeypatch.setattr(Child, "start", lambda child, after: started.append(child.name) or start(child, after))
    with Pipeline(video[0], video[1][0]) as pipeline:
        next(iter(pipeline))
        time.sleep(APART_SECONDS + 2)
        assert len(list(pipeline)) == len(video[1]) - 1
    assert tuple(started) == NAMES

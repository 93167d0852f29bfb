"""A whole pipeline where nobody comes in without a key."""

from contextlib import suppress

import pytest

from catstream.base.settings import Settings
from catstream.client.attach import subscribe
from catstream.errors import ServiceError, SilenceError
from catstream.pipeline import Pipeline
from catstream.processes.start_server import NAMES


def test_a_pipeline_with_keys_loses_no_frame_and_sends_to_allowed_clients(video, folder, keys, tcp):
    path, boxes = video
    settings = Settings(run={"endpoint": tcp.replace("127.0.0.1", "0.0.0.0"), "keys": str(keys), "unstored_frames": 1})
    with (
        Pipeline(path, boxes[0], settings) as pipeline,
        subscribe(tcp, "tracks", keys=str(folder / "anna"), timeout=0.3) as heard,
        subscribe(tcp, "health", keys=str(keys), timeout=150) as health,
    ):
        tracks = iter(pipeline)
        first = next(tracks)
        while (seen := received(heard)) is None:  # while it connects, few pass
            next(tracks)
        named = {next(health).process for _ in NAMES}
        rest = list(tracks)
        assert seen.state
        assert pipeline.health["detector"]["rejected"] == 0
    assert (first.frame, rest[-1].frame) == (0, pipeline.frames - 1)
    assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (pipeline.frames, pipeline.frames)
    assert pipeline.restarts == 0
    assert named <= set(NAMES)


def test_a_pipeline_does_not_start_while_the_key_of_a_client_cannot_be_read(video, keys):
    path, boxes = video
    (keys / "clients" / "anna").write_bytes(b"")
    with (
        pytest.raises(ServiceError, match=r"clients/anna gives the role None"),
        Pipeline(path, boxes[0], {"run.keys": str(keys)}),
    ):
        pass


def received(subscription):
    """The next message, None if none arrives in time."""
    with suppress(SilenceError):
        return next(subscription)


@pytest.mark.parametrize("place", ["0.0.0.0:0", "192.0.2.1:5700", "example.org:5700"])
def test_a_pipeline_that_other_machines_can_reach_does_not_start_without_keys(video, place):
    path, boxes = video
    settings = Settings(run={"endpoint": f"tcp://{place}"})
    with pytest.raises(ServiceError, match="catstream keys new"), Pipeline(path, boxes[0], settings):
        pass

"""A whole pipeline where nobody comes in without a key."""

import pytest

from catstream.base.settings import Settings
from catstream.errors import ServiceError
from catstream.pipeline import Pipeline


def test_a_pipeline_does_not_start_while_the_key_of_a_client_cannot_be_read(video, keys):
    path, boxes = video
    (keys / "clients" / "anna").write_bytes(b"")
    with (
        pytest.raises(ServiceError, match=r"clients/anna gives the role None"),
        Pipeline(path, boxes[0], {"run.keys": str(keys)}),
    ):
        pass


@pytest.mark.parametrize("place", ["0.0.0.0:0", "192.0.2.1:5700", "example.org:5700"])
def test_a_pipeline_that_other_machines_can_reach_does_not_start_without_keys(video, place):
    path, boxes = video
    settings = Settings(run={"endpoint": f"tcp://{place}"})
    with pytest.raises(ServiceError, match="catstream keys new"), Pipeline(path, boxes[0], settings):
        pass

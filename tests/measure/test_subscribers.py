"""The subscribers of a load test: each fast one records arrivals and counts gaps."""

from time import monotonic

import numpy as np
import pytest

from catstream.client.address import Address
from catstream.measure.camera import Schedule
from catstream.measure.latency import Observations
from catstream.measure.load_result import Plan
from catstream.measure.subscribers import Subscribers
from catstream.wire.channels import TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Track
from catstream.wire.newest import Publisher


def test_fast_subscribers_record_each_receipt_and_count_gaps(until, tmp_path):
    schedule, observations = Schedule(start=monotonic() - 1.0, rate=10.0), Observations()
    with (
        Publisher(TRACKS, Endpoint.parse(str(tmp_path))) as publisher,
        Subscribers(Plan(subscribers=3, slow_subscribers=1), 0, "tracks", Address(str(tmp_path))) as subscribers,
    ):

        def send(number, *, is_lost=False):
            track = Track(len(observations.tracks), 0.0, "absent", None, 0.1, 1, schedule.due(number))
            observations.tracks.append((monotonic(), track))
            if not is_lost:
                publisher.send(track)

        until(lambda: send(-1) or subscribers.connected)
        begin = monotonic()
        for number in range(4):
            send(number, is_lost=number == 2)
        publisher.send(End(len(observations.tracks), ""))
        end = monotonic() + 100.0
        receipts = subscribers.receipts(observations, schedule, 5, end)
        received = monotonic()
    assert receipts.missed == [1, 1]
    assert min(receipts.received) >= 3
    arrivals = receipts.latency + schedule.due_times(5)
    assert arrivals[:, 2] == pytest.approx(arrivals[:, 3])  # a lost frame lasts until a newer one
    assert arrivals[:, 4] == pytest.approx([end, end])  # one without an answer, until the end
    assert np.all(np.diff(arrivals[:, :4]) > -1e-3)
    assert np.all((arrivals[:, :4] > begin - 1e-3) & (arrivals[:, :4] < received + 1e-3))

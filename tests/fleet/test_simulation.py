"""The simulation of large fleets: its queues, its placement and its arithmetic."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from catstream.fleet.placement import Node, Task, place

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "benchmarks"), str(ROOT / "benchmarks" / "fleet")]

from model import GB, PERIOD, Costs, Prices, Site, Size  # noqa: E402
from recovery import HeadLost, NodesLost, StoreLost, assigned, simulate  # noqa: E402
from sections import records  # noqa: E402

COSTS = Costs.read(records())
AT, END = 10.0, 1000.0
LATEST_NOTICE = 3 * 1.5 + 2 * 0.5 + 0.5  # of three health checks without an answer


def small(cameras=100, **site):
    return Size(cameras, COSTS, Site(rack=2, **site))


def unqueued(size):
    """Seconds from the manager's decision to the first track, if nothing else goes on."""
    costs, site = size.costs, size.site
    read = costs.state / (site.connection * GB)
    return costs.create + costs.gcs_create + costs.worker + 3 * site.latency + read + costs.start_cpu / 2


def test_the_same_seed_gives_the_same_outcome():
    faults = [NodesLost(AT, range(2), END), HeadLost(AT + 1, 5.0)]
    assert simulate(small(), faults, 3, END) == simulate(small(), faults, 3, END)
    assert simulate(small(), faults, 3, END) != simulate(small(), faults, 4, END)


def test_each_stream_of_a_lost_machine_comes_back_once_and_no_other_stops():
    found = simulate(small(), [NodesLost(AT, range(1), END)], 0, END)
    share = 100 / small().machines
    assert share - 1 < len(found.down) == len(found.unlearnt) < share + 1
    assert found.waiting == 0


def test_a_stream_that_waits_in_no_queue_takes_as_long_as_its_steps():
    size = small(1)
    (down,) = simulate(size, [NodesLost(AT, range(1), END)], 0, END).down
    assert LATEST_NOTICE - PERIOD + unqueued(size) <= down <= LATEST_NOTICE + PERIOD + 2 * size.turn + unqueued(size)


def test_no_stream_comes_back_while_the_store_is_away_or_before_the_head_is_back():
    lost = NodesLost(AT, range(1), END)
    for fault in (StoreLost(AT, 100.0), HeadLost(AT - 1, 101.0)):
        found = simulate(small(), [fault, lost], 0, END)
        assert found.down
        assert min(found.back_at) > AT + 100.0


def test_streams_without_room_wait_for_their_machine():
    size = small()
    found = simulate(size, [NodesLost(AT, range(size.machines), 300.0)], 0, END)
    assert (len(found.down), found.waiting) == (100, 0)
    assert min(found.down) > 300.0
    assert simulate(size, [NodesLost(AT, range(size.machines), 2 * END)], 0, END).waiting == 100


def test_reads_at_once_share_the_bandwidth_of_the_store():
    slow = small(store=0.02, every=1e9)
    found = simulate(slow, [NodesLost(AT, range(1), END)], 0, END)
    least = len(found.down) * COSTS.state / (0.02 * GB)
    assert least < max(found.down) < least + LATEST_NOTICE + 5 * unqueued(slow)


def test_a_slow_store_makes_the_states_older():
    assert small().interval == small().site.every
    slow = small(store=small().store_load / GB / 3)
    assert slow.interval == pytest.approx(3 * slow.site.every)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 4), min_size=1, max_size=8), st.integers(0, 20))
def test_streams_are_placed_as_the_manager_places_them(free, streams):
    nodes = [Node(f"{number:02}", float(room)) for number, room in enumerate(free)]
    tasks = [Task(f"{number:02}", 1.0) for number in range(streams)]
    expected = {int(name): int(node) for name, node in place(tasks, nodes).where.items()}
    assert assigned(range(streams), dict(enumerate(free)), fullest_first=False) == expected


@given(st.integers(1, 50_000), st.integers(1, 50_000))
def test_more_cameras_need_no_less(few, more):
    low, high = (Size(few, COSTS, Site()), Size(few + more, COSTS, Site()))
    assert low.machines <= high.machines
    assert low.store_load < high.store_load
    assert low.turn < high.turn
    assert sum(low.price(Prices()).values()) < sum(high.price(Prices()).values())


def test_the_machines_have_room_for_all_streams_after_the_loss_of_a_rack():
    size = Size(10_000, COSTS, Site())
    assert (size.machines - size.site.rack) * size.slots >= size.cameras
    assert size.slots * COSTS.cores <= size.site.cores * size.site.fill

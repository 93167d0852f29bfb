"""Where streams run: never beyond a node's cores, what may stay stays, and every refusal says why."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.fleet.placement import Node, Task, may_host, objection, place

NORTH, SOUTH = {"site": "north"}, {"site": "south"}
CORES = st.sampled_from([0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 5.0])
LABELS = st.sampled_from([{}, NORTH, SOUTH, {"site": "east"}, NORTH | {"gpu": "yes"}])


@st.composite
def clusters(draw):
    """Streams and nodes. The streams that run do not exceed the cores of their nodes."""
    flags = {"alive": st.booleans(), "draining": st.booleans(), "overloaded": st.booleans()}
    nodes = [
        Node(f"n{number}", draw(st.sampled_from([1.0, 2.0, 4.0])), draw(LABELS), **draw(st.fixed_dictionaries(flags)))
        for number in range(draw(st.integers(0, 4)))
    ]
    free = {node.name: node.cores for node in nodes}
    names = st.sampled_from([*free, None])
    tasks = []
    for number in range(draw(st.integers(0, 10))):
        node, cores = draw(names), draw(CORES)
        if node is not None and cores > free[node]:
            node = None
        if node is not None:
            free[node] -= cores
        unopened = draw(st.lists(names.filter(bool), unique=True)) if nodes else ()
        tasks.append(Task(f"cam-{number}", cores, draw(LABELS), node, draw(names), unopened))
    return tasks, nodes


@given(clusters())
def test_each_stream_has_a_node_that_may_host_it_or_a_reason_that_names_it(cluster):
    tasks, nodes = cluster
    placement, by_name = place(tasks, nodes), {node.name: node for node in nodes}
    assert placement.where.keys() | placement.unplaced.keys() == {task.name for task in tasks}
    assert not placement.where.keys() & placement.unplaced.keys()
    for task in tasks:
        if task.name in placement.where:
            assert may_host(by_name[placement.where[task.name]], task.labels)
        else:
            assert placement.unplaced[task.name].startswith(f"{task.name} needs ")


@given(clusters())
def test_the_cores_of_a_node_are_never_exceeded_even_before_what_leaves_is_gone(cluster):
    tasks, nodes = cluster
    placement = place(tasks, nodes)
    for node in nodes:
        there = [task for task in tasks if node.name in (task.node, placement.where.get(task.name))]
        assert sum(task.cores for task in there) <= node.cores + 1e-6


@given(clusters())
def test_what_is_unplaced_fits_nowhere(cluster):
    tasks, nodes = cluster
    placement = place(tasks, nodes)
    for task in tasks:
        if task.name in placement.unplaced:
            for node in nodes:
                there = [each for each in tasks if node.name in (each.node, placement.where.get(each.name))]
                full = sum(each.cores for each in there) + task.cores > node.cores + 1e-9
                assert full or not may_host(node, task.labels)


@given(clusters())
def test_a_running_stream_leaves_its_node_only_if_it_has_to_is_pinned_or_the_node_is_overloaded(cluster):
    tasks, nodes = cluster
    placement, by_name = place(tasks, nodes), {node.name: node for node in nodes}
    given_away = []
    for task in tasks:
        target = placement.where.get(task.name)
        if task.node is None or target == task.node or not may_host(by_name[task.node], task.labels):
            continue
        assert target is not None
        if target != task.pinned:
            assert by_name[task.node].overloaded
            assert not by_name[target].overloaded
            given_away.append(task.node)
    assert len(given_away) == len(set(given_away)), "one at a time"
    assert not place(tasks, nodes, settling=by_name).where.keys() ^ placement.where.keys()


@given(clusters(), st.randoms())
def test_the_order_of_streams_and_nodes_does_not_matter(cluster, random):
    tasks, nodes = cluster
    placement = place(tasks, nodes)
    random.shuffle(tasks)
    random.shuffle(nodes)
    assert place(tasks, nodes) == placement


@given(clusters())
def test_the_number_of_further_nodes_is_between_the_sum_of_cores_and_a_node_for_each_stream(cluster):
    tasks, nodes = cluster
    placement, size = place(tasks, nodes), max((node.cores for node in nodes), default=0.0)
    counted = [task for task in tasks if task.name in placement.unplaced and task.cores <= size]
    assert sum(task.cores for task in counted) <= placement.more_nodes * size + 1e-6
    assert placement.more_nodes <= len(counted)


def test_streams_that_need_other_labels_need_other_nodes():
    tasks = [Task("a", 1.0, NORTH), Task("b", 1.0, SOUTH), Task("c", 1.0, NORTH), Task("d", 1.0), Task("e", 9.0)]
    assert place(tasks, [Node("full", 2.0, alive=False)]).more_nodes == 2


def test_streams_are_placed_by_best_fit_and_the_largest_first():
    nodes = [Node("large", 4.0), Node("small", 2.0)]
    where = place([Task("a", 0.5), Task("b", 2.0), Task("c", 3.0)], nodes).where
    assert where == {"c": "large", "b": "small", "a": "large"}


@pytest.mark.parametrize(
    ("task", "nodes", "reason"),
    [
        (Task("cam-7", 1.0), [], "cam-7 needs 1 core, and no node is alive: start one with `catstream fleet node`"),
        (
            Task("cam-7", 0.5),
            [Node("n1", 4.0, alive=False)],
            "cam-7 needs 0.5 cores, and no node is alive (n1): start one with `catstream fleet node`",
        ),
        (
            Task("cam-7", 1.0, NORTH),
            [Node("n1", 4.0, SOUTH), Node("n2", 4.0)],
            "cam-7 needs a node with site=north, and there is none: n1 has site=south: correct the labels of the "
            "stream, or add such a node",
        ),
        (
            Task("cam-7", 1.0, NORTH),
            [Node("n1", 4.0, NORTH, alive=False), Node("n2", 4.0)],
            "cam-7 needs a node with site=north, and none is alive: start n1 again",
        ),
        (
            Task("cam-7", 1.0, {"sitte": "north"}),
            [Node("n1", 4.0, NORTH)],
            "cam-7 needs a node with sitte=north, and there is none: no node has the label sitte, did you mean site? "
            "(alive: n1): correct the labels of the stream, or add such a node",
        ),
        (
            Task("cam-7", 1.0),
            [Node("n1", 4.0, draining=True)],
            "cam-7 needs 1 core, and all nodes that it may be on are drained (n1): add a node",
        ),
        (
            Task("cam-7", 6.0, NORTH),
            [Node("n1", 4.0, NORTH), Node("n2", 8.0)],
            "cam-7 needs 6 cores, and the largest node with site=north, n1, has 4: give it fewer cores, or add a "
            "larger node",
        ),
        (
            Task("cam-7", 2.0),
            [Node(f"n{number}", 1.0 + number) for number in range(8)],
            "",
        ),
    ],
)
def test_a_refusal_says_what_is_needed_and_what_there_is(task, nodes, reason):
    assert objection(task, nodes, {node.name: node.cores for node in nodes}) == reason


def test_a_refusal_names_the_first_few_of_many_nodes():
    nodes = [Node(f"n{number}", 4.0) for number in range(100)]
    text = objection(Task("cam-7", 2.0), nodes, dict.fromkeys((node.name for node in nodes), 0.25))
    assert "n4 has 0.25 of 4 and 95 more: give it fewer cores" in text


def test_streams_are_spread_over_the_nodes():
    tasks = [Task(f"cam-{number}", 0.5) for number in range(6)]
    where = place(tasks, [Node("n1", 8.0), Node("n2", 8.0), Node("n3", 8.0)]).where
    assert sorted(where.values()) == ["n1", "n1", "n2", "n2", "n3", "n3"]

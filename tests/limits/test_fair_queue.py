"""Tenants are served in turn, then their robots, and who holds most gives a place up."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.identity import RobotId
from rse_pf.limits.fair_queue import FairQueue, largest_holder


def robot_of(text: str) -> RobotId:
    """Return the robot ``TENANT/NAME``; its tenant is ``t`` without one."""
    tenant, slash, name = text.rpartition("/")
    return RobotId(tenant if slash else "t", name)


def served(queue: FairQueue[str], count: int) -> str:
    """Serve *count* items, one after the other, and return the first letter of each."""
    return "".join(served_item(queue)[0] for _ in range(count))


def served_item(queue: FairQueue[str]) -> str:
    """Serve the next item to its end."""
    item = queue.take()
    assert item is not None
    queue.release(robot_of(item.split(":")[0]))
    return item


@pytest.mark.parametrize(
    ("waiting", "order"),
    [
        pytest.param({"a": 5, "b": 2}, "ababaaa", id="robots of one tenant"),
        pytest.param({"m/1": 2, "m/2": 2, "m/3": 2, "f/1": 2}, "mfmfmmmm", id="tenants, not robots"),
        pytest.param({"x/1": 1, "y/1": 1, "z/1": 1}, "xyz", id="in the order of arrival"),
    ],
)
def test_the_least_recently_served_tenant_goes_first_and_there_the_least_recently_served_robot(
    waiting, order
):
    queue: FairQueue[str] = FairQueue()
    for name, count in waiting.items():
        for number in range(count):
            queue.add(robot_of(name), f"{name}:{number}")

    assert served(queue, len(order)) == order
    assert queue.take() is None
    assert len(queue) == 0


@pytest.mark.parametrize(
    ("limits", "running"),
    [
        ({}, ["x/1", "x/1", "x/2", "y/1"]),
        ({"max_running_per_robot": 1}, ["x/1", "x/2", "y/1"]),
        ({"max_running_per_tenant": 1}, ["x/1", "y/1"]),
    ],
)
def test_no_more_items_run_than_allowed_and_a_robot_is_served_again_when_one_ends(limits, running):
    queue: FairQueue[str] = FairQueue(**limits)
    for name in ("x/1", "x/1", "x/2", "y/1"):
        queue.add(robot_of(name), name)
    taken = []
    while (item := queue.take()) is not None:
        taken.append(item)

    assert sorted(taken) == running
    if limits:
        queue.release(robot_of("x/1"))
        assert queue.take() == ("x/1" if "max_running_per_robot" in limits else "x/2")


def test_the_tenant_with_the_fewest_running_items_goes_before_one_that_waits_for_longer():
    queue: FairQueue[str] = FairQueue()
    for number in range(4):
        queue.add(robot_of("x/1"), f"x{number}")
    assert [queue.take(), queue.take()] == ["x0", "x1"]
    queue.add(robot_of("y/1"), "y0")
    queue.add(robot_of("y/2"), "y1")

    assert [queue.take(), queue.take(), queue.take()] == ["y0", "y1", "x2"]


@given(st.lists(st.sampled_from(["x/1", "x/2", "y/1"]), max_size=30))
def test_while_tenants_wait_none_is_served_twice_more_than_another(comers: list[str]):
    queue: FairQueue[str] = FairQueue()
    for name in comers:
        queue.add(robot_of(name), name)
    left = {tenant: sum(name[0] == tenant for name in comers) for tenant in "xy"}
    turns = dict.fromkeys(left, 0)
    while len(queue):
        tenant = served(queue, 1)
        turns[tenant] += 1
        left[tenant] -= 1
        waiting = [turns[each] for each in left if left[each]]
        assert not waiting or max(waiting) - min(waiting) <= 1


@pytest.mark.parametrize(
    ("robot", "position"),
    [("x/1", 8), ("x/9", 6), ("y/1", 8), ("z/1", 3), ("x/3", 4)],
    ids=[
        "behind its own items",
        "of a tenant with two",
        "behind its own four",
        "of a new tenant",
        "its second",
    ],
)
def test_the_position_counts_one_item_of_each_robot_and_tenant_for_each_own_item(robot: str, position: int):
    queue: FairQueue[str] = FairQueue()
    waiting = {"x/1": 2, "x/2": 1, "y/1": 4} if robot != "x/3" else {"x/1": 9, "x/3": 1}
    for name, count in waiting.items():
        for _ in range(count):
            queue.add(robot_of(name), name)

    assert queue.position(robot_of(robot)) == position


@given(
    st.lists(st.sampled_from(["x/1", "x/2", "y/1", "y/2", "z/1"]), max_size=30),
    st.integers(0, 10),
    st.sampled_from(["x/1", "z/1", "new/1"]),
)
def test_no_item_is_served_after_its_position_while_one_runs_at_a_time_and_none_arrives(
    comers: list[str], first_served: int, robot: str
):
    queue: FairQueue[str] = FairQueue(max_running_per_robot=1)
    for name in comers:
        queue.add(robot_of(name), f"{name}:")
    served(queue, min(first_served, len(queue)))
    running = queue.take()
    position = queue.position(robot_of(robot))
    queue.add(robot_of(robot), f"{robot}:last")
    if running is not None:
        queue.release(robot_of(running.split(":")[0]))

    order = [served_item(queue) for _ in range(len(queue))]

    assert order.index(f"{robot}:last") + 1 <= position


@pytest.mark.parametrize(
    ("held", "newcomer", "donor"),
    [
        ({"a": 3, "b": 2}, "c", "a"),
        ({"a": 2}, "a", None),
        ({"a": 2, "b": 1}, "b", None),
        ({"m/1": 1, "m/2": 1, "m/3": 2}, "f/1", "m/3"),
        ({"m/1": 1, "m/2": 1}, "f/1", "m/1"),
        ({"m/1": 1, "m/2": 1}, "m/3", None),
        ({"m/1": 1, "m/2": 1, "f/1": 1}, "f/2", None),
        ({"busy/1": 9, "m/1": 3}, "f/1", "m/1"),
        ({"busy/1": 9}, "f/1", None),
        ({}, "f/1", None),
    ],
)
def test_who_holds_at_least_two_more_gives_one_place_up(held, newcomer, donor):
    found = largest_holder(
        {robot_of(name): count for name, count in held.items()},
        robot_of(newcomer),
        lambda robot: robot.tenant != "busy",
    )

    assert found == (None if donor is None else robot_of(donor))

"""Which of a robot's sockets ends when it has two."""

from __future__ import annotations

from rse_pf.server.supervisor.orders import ReplaceOrder, WorkerOrder
from rse_pf.server.supervisor.session_registry import SessionRegistry


class Worker:
    def __init__(self) -> None:
        self.orders: list[WorkerOrder] = []

    def order(self, order: WorkerOrder) -> None:
        self.orders.append(order)


def say(event: str, number: int, robot: str = "r", tenant: str = "default") -> dict[str, object]:
    return {"event": event, "robot": [tenant, robot, ""], "number": number}


def test_the_socket_that_was_accepted_earlier_ends_on_its_own_worker():
    registry, one, two = SessionRegistry(), Worker(), Worker()
    registry.handle(one, say("arrived", 1))
    registry.handle(two, say("arrived", 2))

    assert (one.orders, two.orders) == ([ReplaceOrder(1)], [])


def test_a_slow_worker_cannot_make_the_older_socket_win():
    registry, slow, quick = SessionRegistry(), Worker(), Worker()
    registry.handle(quick, say("arrived", 2))
    registry.handle(slow, say("arrived", 1))

    assert (slow.orders, quick.orders) == ([ReplaceOrder(1)], [])


def test_robots_of_the_same_name_in_two_tenants_are_two():
    registry, worker = SessionRegistry(), Worker()
    registry.handle(worker, say("arrived", 1, tenant="a"))
    registry.handle(worker, say("arrived", 2, tenant="b"))
    registry.handle(worker, say("arrived", 3, robot="s", tenant="a"))

    assert worker.orders == []
    assert len(registry) == 3


def test_a_socket_that_stayed_for_a_move_ends_after_it_only_if_a_newer_one_is_there():
    registry, old, new = SessionRegistry(), Worker(), Worker()
    registry.handle(old, say("arrived", 1))
    registry.handle(new, say("arrived", 2))
    old.orders.clear()

    registry.handle(old, say("stays", 1))
    assert old.orders == [ReplaceOrder(1)]
    registry.handle(new, say("left", 2))
    registry.handle(old, say("stays", 1))

    assert old.orders == [ReplaceOrder(1)]


def test_a_robot_that_left_is_forgotten():
    registry, worker = SessionRegistry(), Worker()
    for number in (1, 2, 3):
        registry.handle(worker, say("arrived", number))
        registry.handle(worker, say("left", number))

    assert worker.orders == []
    assert len(registry) == 0

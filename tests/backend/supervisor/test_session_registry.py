"""Which of a robot's sockets ends when it has two."""

from __future__ import annotations

from typing import Any

from rse_pf.backend.supervisor.session_registry import SessionRegistry


class Worker:
    def __init__(self) -> None:
        self.orders: list[dict[str, Any]] = []

    def order(self, **what: Any) -> None:
        self.orders.append(what)


def say(event: str, number: int, robot: str = "r", tenant: str = "default") -> dict[str, object]:
    return {"event": event, "tenant": tenant, "robot": robot, "number": number}


def replaced(number: int) -> dict[str, object]:
    return {"do": "replace", "number": number}


def test_the_socket_that_was_accepted_earlier_ends_on_its_own_worker():
    presence, one, two = SessionRegistry(), Worker(), Worker()
    presence.hear(one, say("arrived", 1))
    presence.hear(two, say("arrived", 2))

    assert (one.orders, two.orders) == ([replaced(1)], [])


def test_a_slow_worker_cannot_make_the_older_socket_win():
    presence, slow, quick = SessionRegistry(), Worker(), Worker()
    presence.hear(quick, say("arrived", 2))
    presence.hear(slow, say("arrived", 1))

    assert (slow.orders, quick.orders) == ([replaced(1)], [])


def test_robots_of_the_same_name_in_two_tenants_are_two():
    presence, worker = SessionRegistry(), Worker()
    presence.hear(worker, say("arrived", 1, tenant="a"))
    presence.hear(worker, say("arrived", 2, tenant="b"))
    presence.hear(worker, say("arrived", 3, robot="s", tenant="a"))

    assert worker.orders == []


def test_a_socket_that_stayed_for_a_move_ends_after_it_only_if_a_newer_one_is_there():
    presence, old, new = SessionRegistry(), Worker(), Worker()
    presence.hear(old, say("arrived", 1))
    presence.hear(new, say("arrived", 2))
    old.orders.clear()

    presence.hear(old, say("stays", 1))
    assert old.orders == [replaced(1)]
    presence.hear(new, say("left", 2))
    presence.hear(old, say("stays", 1))

    assert old.orders == [replaced(1)]


def test_who_left_is_forgotten():
    presence, worker = SessionRegistry(), Worker()
    for number in (1, 2, 3):
        presence.hear(worker, say("arrived", number))
        presence.hear(worker, say("left", number))

    assert worker.orders == []
    assert presence._sockets == {}

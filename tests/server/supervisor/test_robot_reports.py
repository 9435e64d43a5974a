"""Workers report robots to their supervisor: events in batches, and a list without anything secret."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from rse_pf.identity import RobotId
from rse_pf.server.supervisor.robot_reports import RobotEvents, robot_rows
from tests.kit.fakes import FakeLoop

LINE_BYTES = 1 << 20
"""The longest line that the supervisor reads of a worker's channel."""


class Bench:
    """Events on a loop whose clock the test moves; keeps the messages."""

    def __init__(self) -> None:
        self.loop = FakeLoop()
        self.messages: list[list[dict[str, Any]]] = []
        self.events = RobotEvents(self.loop, self.say)  # type: ignore[arg-type]

    def say(self, *, event: str, robots: list[dict[str, Any]]) -> None:
        assert event == "robots"
        self.messages.append(robots)


def test_no_message_is_longer_than_the_line_that_the_supervisor_reads() -> None:
    bench = Bench()
    robot = ["t" * 64, "r" * 64, ""]

    for number in range(1201):
        bench.events.add(event="arrived", robot=robot, number=number)
    bench.loop.advance(0.02)

    assert [len(message) for message in bench.messages] == [500, 500, 201]
    assert [event["number"] for message in bench.messages for event in message] == list(range(1201))
    assert all(len(repr(message)) < LINE_BYTES for message in bench.messages)


def connection(name: str, tenant: str = "default", **changed: Any) -> Any:
    fields = {
        "robot": RobotId(tenant, name), "session": SimpleNamespace(codec=SimpleNamespace(name="bin")),
        "opened_s": 10.0, "commands": 3, "last_result": "busy", "is_shown": True, "is_closing": False,
        **changed,
    }  # fmt: skip
    return SimpleNamespace(**fields)


def test_robots_are_listed_by_tenant_and_name_with_the_age_of_their_connections() -> None:
    rows = robot_rows([connection("b"), connection("a"), connection("z", "another")], 12.5)

    assert [(row["tenant"], row["robot"]) for row in rows] == [
        ("another", "z"), ("default", "a"), ("default", "b"),
    ]  # fmt: skip
    assert rows[1] == {
        "robot": "a", "tenant": "default", "codec": "bin", "connected_s": 2.5, "commands": 3,
        "last_result": "busy",
    }  # fmt: skip


def test_sockets_that_are_no_robots_yet_or_any_more_are_left_out() -> None:
    others = [
        connection("a", session=None),
        connection("b", is_shown=False),
        connection("c", is_closing=True),
    ]

    assert robot_rows(others, 12.5) == []

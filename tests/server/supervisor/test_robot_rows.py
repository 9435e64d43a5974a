"""The rows of an operator's list of robots: who is connected, and nothing that is secret."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from rse_pf.identity import RobotId
from rse_pf.server.supervisor.robot_rows import robot_rows


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

"""`rse-pf service publish` and the agent: from a folder by the bucket to what a server runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.cli.main import main
from rse_pf.services.custom.installed import installed_services
from rse_pf.services.custom.publishing import LIST_NAME
from tests.kit.fake_machine import FakeMachine, FakeScaling, agent_context

Capture = pytest.CaptureFixture[str]


class Server:
    """An agent with a fake machine: its services folder, and what it logged."""

    def __init__(self, s3: Any, folder: Path) -> None:
        self.machine, self.log = FakeMachine(), []  # type: FakeMachine, list[tuple[str, dict[str, Any]]]
        self.current = folder / "services" / "current"
        context = agent_context(
            self.machine, folder, clients={"autoscaling": FakeScaling(self.machine)},
            artifacts=S3Store(s3, "artifacts"), log=lambda event, **fields: self.log.append((event, fields)),
        )  # fmt: skip
        self.agent = Agent(context)

    def look(self) -> list[str]:
        """Let the agent look at the list; return the services that run then."""
        self.agent.attempt("services")
        return [each.name for each in installed_services(self.current.resolve())]

    def events(self) -> list[str]:
        found = [name for name, _ in self.log]
        self.log.clear()
        return found


@pytest.fixture
def server(cloud: Any, tmp_path: Path) -> Server:
    return Server(cloud, tmp_path / "var")


def test_a_published_service_is_run_replaced_and_taken_out(
    cloud: Any, server: Server, capsys: Capture
) -> None:
    assert server.look() == []
    assert server.machine.reloads == 1
    for name in ("one", "two"):
        assert main(["service", "new", name, "--lang", "lua"]) == 0
        assert main(["service", "publish", name]) == 0

    assert server.look() == ["one", "two"]
    assert server.look() == ["one", "two"]
    assert server.machine.reloads == 2, "a list that did not change is not loaded again"
    capsys.readouterr()
    assert main(["service", "publish", "--list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [(each["name"], each["language"]) for each in listed] == [("one", "lua"), ("two", "lua")]

    source = Path("two/service.lua")
    source.write_text(source.read_text() + "\n-- changed\n")
    assert main(["service", "publish", "two"]) == 0
    assert main(["service", "publish", "one", "--remove"]) == 0
    assert server.look() == ["two"]
    assert "-- changed" in (server.current / "two" / "service.lua").read_text()
    assert server.machine.reloads == 3


def test_nothing_runs_that_the_list_does_not_name_with_its_digest(cloud: Any, server: Server) -> None:
    assert main(["service", "new", "one", "--lang", "lua"]) == 0
    assert main(["service", "publish", "one"]) == 0
    assert server.look() == ["one"]
    assert main(["service", "new", "two", "--lang", "lua"]) == 0
    assert main(["service", "publish", "two"]) == 0
    listed = json.loads(cloud.get_object(Bucket="artifacts", Key=LIST_NAME)["Body"].read())
    name = f"services/archives/{listed['services'][1]['archive']}"
    other = cloud.get_object(Bucket="artifacts", Key=f"services/archives/{listed['services'][0]['archive']}")
    cloud.put_object(Bucket="artifacts", Key=name, Body=other["Body"].read())
    server.events()

    assert server.look() == ["one"]
    assert server.events() == ["failed"]
    assert server.look() == ["one"]
    assert server.events() == [], "a list that was refused is not fetched again and again"

    assert main(["service", "publish", "two"]) == 0
    assert server.look() == ["one", "two"]


def test_a_server_that_does_not_run_yet_is_notified_later(cloud: Any, server: Server) -> None:
    assert main(["service", "new", "one", "--lang", "lua"]) == 0
    assert main(["service", "publish", "one"]) == 0
    server.machine.runs = False

    assert server.look() == ["one"]
    assert server.machine.reloads == 0
    server.machine.runs = True
    server.look()
    assert server.machine.reloads == 1


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (["nowhere"], 2, "cannot read"),
        (["nowhere", "--remove"], 2, "no service 'nowhere' is published"),
        ([], 2, "needs the folder"),
        (["x", "--list"], 2, "--list takes no service"),
        (["--list", "--remove"], 2, "--list takes no service"),
        (["x", "--json"], 2, "--json is for --list"),
    ],
)
def test_wrong_orders_are_one_line_with_a_hint(
    cloud: Any, capsys: Capture, words: list[str], code: int, error: str
) -> None:
    assert main(["service", "publish", *words]) == code
    said = capsys.readouterr().err
    assert error in said
    assert "hint:" in said
    assert "Traceback" not in said

"""Services that are published, changed and taken out while robots call them: no command is lost."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.task import AgentConfig, AgentContext
from rse_pf.config import PlatformSettings
from rse_pf.services.custom.installed import install
from rse_pf.services.custom.publishing import publish
from rse_pf.storage.object_store import DirectoryStore
from rse_pf.wire import Failure, Result

pytestmark = [pytest.mark.slow, pytest.mark.system]

SOURCE = """
from __future__ import annotations
import time, msgspec

class Request(msgspec.Struct):
    rest_s: float = 0.0

class Reply(msgspec.Struct):
    version: int
    count: int

class Service:
    def __init__(self):
        self.count = 0

    def snapshot(self):
        return str(self.count).encode()

    def restore(self, data):
        self.count = int(data)

    def serve(self, request: Request) -> Reply:
        time.sleep(request.rest_s)
        self.count += 1
        return Reply(version=VERSION, count=self.count)
"""


class Operator:
    """Publishes versions of one service, and has the agent of the server's machine look at once."""

    def __init__(self, folder: Path, server: Any) -> None:
        self.folder, self.bucket = folder, DirectoryStore(folder / "artifacts")
        self.log: list[str] = []
        clients: dict[str, Any] = {"autoscaling": None}
        self.agent = Agent(
            AgentContext(
                machine=Instance(server.identity["control_port"]), clients=clients, artifacts=self.bucket,
                config=AgentConfig(
                    group="g", hook="h", launch_hook="l", keys_name="keys.json",
                    keys_file=folder / "var" / "keys.json", state_folder=folder / "var",
                ),
                settings=PlatformSettings(), log=lambda event, **fields: self.log.append(event),
            )
        )  # fmt: skip

    def publish(self, version: int) -> None:
        source = self.folder / f"v{version}" / "counter"
        source.mkdir(parents=True)
        (source / "service.json").write_text(
            json.dumps(
                {"name": "counter", "language": "python", "entry": "service.py", "kind": "per_robot_state"}
            )
        )
        (source / "service.py").write_text(f"{SOURCE}\nVERSION = {version}\n")
        service = install(source, self.folder / f"root{version}")
        publish(service, self.folder / f"root{version}", self.bucket, now_s=1e9)
        self.agent.attempt("services")
        assert "failed" not in self.log


async def test_versions_change_while_robots_call_and_state_and_order_stay(
    start_server: Callable[..., Any], tmp_path: Path
) -> None:
    (tmp_path / "artifacts").mkdir()
    (tmp_path / "var").mkdir()
    current = tmp_path / "var" / "services" / "current"
    server = start_server(
        keys=True, services={"folder": str(current), "follow": True, "accept_weak_isolation": True},
        data={"store": f"dir:{tmp_path / 'store'}"}, session={"max_commands_per_s": 0},
    )  # fmt: skip
    operator = Operator(tmp_path, server)

    async def call(robot: Any, number: int, rest_s: float = 0.0) -> Result | Failure:
        answer: Result | Failure = await robot.ask(
            number, "counter", {"rest_s": rest_s}, deadline_ms=20_000.0, keep=True
        )
        return answer

    async with server.robot(token=server.token("a")) as robot:
        assert (await call(robot, 0)).code == "unknown-service"
        await asyncio.to_thread(operator.publish, 1)
        seen: list[tuple[int, int]] = []
        number, published = 0, 1
        while not seen or seen[-1][0] < 3:
            number += 1
            answer = await call(robot, number, 0.02)
            if isinstance(answer, Failure):
                assert answer.code == "unknown-service", server.text
                assert not seen, f"{answer} after {seen[-1:]}"
                continue
            seen.append((answer.reply["version"], answer.reply["count"]))
            if len(seen) >= 5 * published and published < 3 and seen[-1][0] == published:
                published += 1
                await asyncio.to_thread(operator.publish, published)
        assert [version for version, _ in seen] == sorted(version for version, _ in seen)
        assert [count for _, count in seen] == list(range(1, len(seen) + 1)), "a command was lost"
        assert server.status()["isolation"]["services"] == ["counter"]
    assert server.process.poll() is None


def test_a_server_starts_without_services_that_were_changed_on_its_disk(
    start_server: Callable[..., Any], tmp_path: Path
) -> None:
    broken = tmp_path / "broken" / "x"
    broken.mkdir(parents=True)
    (broken / "service.json").write_text("{}")

    server = start_server(services={"folder": str(tmp_path / "broken"), "follow": True})

    assert "was not installed" in server.wait_for_log("services-refused")["reason"]
    assert server.http("/readyz")[0] == 200
    status, _, body = server.http("/services", "POST")
    assert (status, json.loads(body)) == (202, {"workers": 1})


def test_a_server_that_follows_nothing_refuses_to_load_services(start_server: Callable[..., Any]) -> None:
    status, _, body = start_server().http("/services", "POST")

    assert (status, json.loads(body)["code"]) == (403, "forbidden")

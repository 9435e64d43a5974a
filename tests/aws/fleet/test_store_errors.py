"""A bucket that does not answer is published every ten seconds, and a server that reaches it says nothing."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import pytest

from rse_pf.aws.fleet import instance
from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.task import AgentState, Phase
from rse_pf.aws.fleet.tasks import store_errors
from rse_pf.config import PlatformSettings
from rse_pf.errors import Disconnected
from tests.kit.fake_machine import FakeMachine, agent_context


class CloudWatch:
    """Takes what is published."""

    def __init__(self) -> None:
        self.published: list[dict[str, Any]] = []

    def put_metric_data(self, **arguments: Any) -> dict[str, Any]:
        assert arguments["Namespace"] == "RsePf"
        self.published += arguments["MetricData"]
        return {}


class Setup:
    """The task on a fake machine, in any group and with any settings."""

    def __init__(self, *, group: str = "rse-pf", **groups: Any) -> None:
        self.machine, self.cloudwatch, self.log = FakeMachine(), CloudWatch(), list[str]()
        context = agent_context(
            self.machine, Path(), group=group, clients={"cloudwatch": self.cloudwatch},
            settings=PlatformSettings.from_dict(groups), state=AgentState(phase=Phase.SERVING),
            log=lambda event, **fields: self.log.append(event),
        )  # fmt: skip
        self.agent = Agent(context, (store_errors.task,))

    def look(self, *reaches: bool) -> None:
        for each in reaches:
            self.machine.reaches = each
            self.agent.attempt("store-errors")


def test_only_failures_are_published_and_each_change_is_one_line() -> None:
    setup = Setup()

    setup.look(True, False, False, True, True)

    assert setup.cloudwatch.published == 2 * [
        {
            "MetricName": "StoreErrors", "Dimensions": [{"Name": "AutoScalingGroupName", "Value": "rse-pf"}],
            "Value": 1.0, "Unit": "Count", "StorageResolution": 1,
        }
    ]  # fmt: skip
    assert setup.log == ["store-silent", "store-back"]


class _Pages(BaseHTTPRequestHandler):
    """The control port and the data service of a server, by status of each page."""

    statuses: ClassVar[dict[str, int]] = {}
    silent: ClassVar[threading.Event]

    def do_GET(self) -> None:
        status = self.statuses.get(self.path, 404)
        if not status:
            self.silent.wait(10)
            return
        self.send_response(status)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[Instance]:
    _Pages.statuses = {"/readyz": 200, "/data/healthz": 200, "/data/readyz": 200}
    _Pages.silent = threading.Event()
    monkeypatch.setattr(instance, "_TIMEOUT_S", 0.3)
    with ThreadingHTTPServer(("127.0.0.1", 0), _Pages) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield Instance(server.server_port, None, server.server_port)
        _Pages.silent.set()
        server.shutdown()
        thread.join()


@pytest.mark.system
@pytest.mark.parametrize("status", [503, 0])
def test_a_silent_bucket_ends_no_machine_that_starts_and_is_told(machine: Instance, status: int) -> None:
    assert (machine.is_ready(), machine.reaches_store()) == (True, True)

    _Pages.statuses["/data/readyz"] = status

    assert (machine.is_ready(), machine.reaches_store()) == (True, False)


@pytest.mark.system
def test_a_data_service_that_is_gone_is_another_trouble(machine: Instance) -> None:
    _Pages.statuses["/data/healthz"] = 503

    assert not machine.is_ready()
    with pytest.raises(Disconnected):
        machine.reaches_store()
    with pytest.raises(Disconnected, match="no data service"):
        Instance(1).reaches_store()

"""The agent's tasks: metrics in every period, keys when they change, the drain once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ClientError

from rse_pf.audit.log import log_files, log_names, read_logs, record_once
from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import DENY_NAME, ROBOTS_NAME, AccessControlStore
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.storage.audit_archive import Shipper, fetch_audit
from rse_pf.errors import RsePfError, StoreError
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.storage.object_store import DirectoryStore, MemoryStore
from tests.kit.fake_machine import FakeMachine, FakeScaling, agent_context

KEYS = SigningKey.from_seed(b"k" * 32, "test-key").key_set().to_json().encode()
PAGE = 'rse_pf_requests_total{{result="ok",service="pnp"}} {requests}\nrse_pf_robots {robots}\n'


class AgentSetup:
    """An agent with everything around it."""

    def __init__(self, folder: Path, cloudwatch: Any) -> None:
        self.machine = FakeMachine()
        self.scaling = FakeScaling(self.machine)
        self.artifacts = MemoryStore()
        self.file = folder / "keys.json"
        self.log: list[tuple[str, dict[str, Any]]] = []
        self.audit, self.archive = folder / "audit", MemoryStore()
        shipper = Shipper(
            self.audit, self.archive, marks_file=folder / "shipped.json", instance=self.machine.instance_id
        )
        context = agent_context(
            self.machine, folder, clients={"cloudwatch": cloudwatch, "autoscaling": self.scaling},
            artifacts=self.artifacts, shipper=shipper,
            log=lambda event, **fields: self.log.append((event, fields)),
        )  # fmt: skip
        self.agent = Agent(context)

    def note(self, action: str) -> None:
        """Have the server write an entry."""
        record_once(self.audit, self.machine.instance_id(), action, wall_clock=lambda: 1e9)

    def archived(self) -> int:
        """Return the number of entries that are safe in the bucket."""
        folder = self.audit.with_name(f"fetched-{len(list(self.audit.parent.iterdir()))}")
        fetch_audit(self.archive, folder)
        return len(read_logs(path for who in log_names(folder) for path in log_files(folder, who)))

    def events(self) -> list[str]:
        return [event for event, _ in self.log]


class Counting:
    """A CloudWatch that remembers what was published."""

    def __init__(self) -> None:
        self.published: list[dict[str, Any]] = []

    def put_metric_data(self, **arguments: Any) -> dict[str, Any]:
        self.published.append(arguments)
        return {}


@pytest.fixture
def setup(tmp_path: Path) -> AgentSetup:
    return AgentSetup(tmp_path, Counting())


def test_the_emulator_accepts_the_metrics_under_the_names_of_the_alarms(tmp_path: Path, region: str) -> None:
    cloudwatch = make_client("cloudwatch", region)
    setup = AgentSetup(tmp_path, cloudwatch)
    for requests in (10, 17):
        setup.machine.text = PAGE.format(requests=requests, robots=3)
        setup.agent.step()
        setup.machine.sleep(60.0)

    now = datetime.now(timezone.utc)

    def total(name: str, statistic: str) -> float:
        found = cloudwatch.get_metric_statistics(
            Namespace=NAMESPACE, MetricName=name, Period=3600, Statistics=[statistic],
            Dimensions=[{"Name": "AutoScalingGroupName", "Value": "rse-pf"}],
            StartTime=now - timedelta(hours=1), EndTime=now + timedelta(hours=1),
        )  # fmt: skip
        return sum(point[statistic] for point in found["Datapoints"])

    assert total("Requests", "Sum") == 7, "counts from before the agent's start were published"
    assert total("Robots", "Maximum") == 3
    assert "failed" not in setup.events()


def test_without_keys_robots_are_refused_and_one_line_says_so(setup: AgentSetup) -> None:
    for _ in range(3):
        setup.agent.step()
        setup.machine.sleep(60.0)

    assert setup.file.read_text() == '{"keys":[]}\n'
    assert setup.events().count("no-keys") == 1


def test_an_invalid_key_set_does_not_replace_the_keys(setup: AgentSetup) -> None:
    setup.artifacts.put("keys.json", KEYS)
    setup.agent.run("keys")
    setup.artifacts.put("keys.json", b"<html>sorry</html>")
    setup.agent.step()

    assert setup.file.read_bytes() == KEYS
    assert ("failed", "keys") in [(event, fields.get("task")) for event, fields in setup.log]


def test_a_terminating_instance_drains_once_and_publishes_nothing_more(tmp_path: Path) -> None:
    counting = Counting()
    setup = AgentSetup(tmp_path, counting)
    setup.machine.leaving = True

    for _ in range(30):
        setup.agent.step()
        setup.machine.sleep(5.0)

    assert len(setup.scaling.completed) == 1
    assert len(setup.machine.waits) == 1
    assert counting.published == []


def test_a_refused_hook_is_retried(setup: AgentSetup, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**arguments: Any) -> None:
        raise ClientError({"Error": {"Code": "ValidationError"}}, "CompleteLifecycleAction")

    setup.machine.leaving = True
    with monkeypatch.context() as patch:
        patch.setattr(setup.scaling, "complete_lifecycle_action", refuse)
        setup.agent.step()
    assert not setup.agent.has_left
    setup.agent.step()

    assert setup.agent.has_left
    assert len(setup.scaling.completed) == 1


def test_a_full_disk_or_an_unreadable_roster_keeps_no_revocation_from_the_server(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path], tmp_path: Path
) -> None:
    disk = small_disk("4m")
    context = agent_context(FakeMachine(), disk)
    config = dataclasses.replace(context.config, keys_file=tmp_path / "run" / "keys.json")
    agent = Agent(dataclasses.replace(context, config=config))
    config.keys_file.parent.mkdir()
    control = AccessControlStore(context.artifacts)
    control.create_missing()
    agent.run("access-control")

    fill(disk)
    context.artifacts.put(ROBOTS_NAME, b"nonsense")
    control.change_deny_list(lambda denied: denied.with_robot("default", "lost", 1.0))
    with pytest.raises(RsePfError):  # only the roster
        agent.run("access-control")

    received = AccessControlStore(DirectoryStore(config.keys_file.parent)).deny_list()
    assert received.is_disabled("default", "lost")


@pytest.mark.parametrize("harm", ["invalid", "missing"])
def test_an_invalid_or_missing_deny_list_changes_nothing_on_the_machine(setup: AgentSetup, harm: str) -> None:
    AccessControlStore(setup.artifacts).change_deny_list(
        lambda denied: denied.with_robot("default", "r", 1.0)
    )
    setup.agent.run("access-control")
    good = (setup.file.parent / DENY_NAME).read_bytes()
    if harm == "missing":
        setup.artifacts.delete(DENY_NAME)
    else:
        setup.artifacts.put(DENY_NAME, b"nonsense")

    class Enough(Exception):
        pass

    def stop(_: float) -> None:
        raise Enough

    with pytest.raises(Enough):
        setup.agent.repeat("access-control", stop)

    assert (setup.file.parent / DENY_NAME).read_bytes() == good
    assert setup.events() == ["fetched"] + ["failed"] * (harm == "invalid")


def test_the_audit_log_is_uploaded_in_its_own_period_and_only_new_entries(setup: AgentSetup) -> None:
    setup.note("first")
    setup.agent.step()
    assert setup.archived() == 1
    setup.note("second")
    setup.agent.step()
    assert setup.archived() == 1, "not before its time"
    setup.machine.sleep(60.0)
    setup.agent.step()
    setup.machine.sleep(60.0)
    setup.agent.step()

    assert setup.archived() == 2
    assert setup.events().count("shipped") == 2


def test_what_a_server_logs_while_it_drains_is_uploaded_before_the_hook_is_completed(tmp_path: Path) -> None:
    setup = AgentSetup(tmp_path, Counting())
    setup.note("lived")
    setup.machine.leaving = True
    drain, complete = setup.machine.drain, setup.scaling.complete_lifecycle_action
    safe: list[int] = []

    def drained(wait_s: float) -> None:
        setup.note("drained")
        drain(wait_s)

    def completed(**arguments: Any) -> dict[str, Any]:
        safe.append(setup.archived())
        return complete(**arguments)

    setup.machine.drain = drained  # type: ignore[method-assign]
    setup.scaling.complete_lifecycle_action = completed  # type: ignore[method-assign]
    setup.agent.step()

    assert safe == [2]
    assert setup.agent.has_left


def test_an_unreachable_bucket_keeps_no_instance_from_terminating(
    setup: AgentSetup, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: Any) -> None:
        raise StoreError("AWS does not answer")

    monkeypatch.setattr(setup.archive, "compare_and_swap", away)
    setup.note("lived")
    setup.machine.leaving = True
    setup.agent.step()

    assert len(setup.scaling.completed) == 1
    assert [fields["task"] for event, fields in setup.log if event == "failed"].count("audit") == 3

"""The alarms of the templates on LocalStack, whose CloudWatch evaluates them: they fire, and they resolve.

It evaluates alarms of one metric.  One whose expression compares one metric with a number becomes such an
alarm, with a period of 10 s; those that need metric math or a percentile are in `NOT_EVALUATED`, and are
evaluated by tests/scaling/test_alarm_states.py alone.  What servers publish comes from the agent's own tasks.
"""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from localstack.conftest import SETTINGS, Deployment

from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.task import AgentConfig, AgentContext
from rse_pf.aws.fleet.tasks import server_metrics, store_errors
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.storage.object_store import MemoryStore
from tests.kit.emulated_aws import REGION
from tests.kit.fake_machine import FakeMachine

NOT_EVALUATED = {
    "balancer-errors",
    "canary",
    "few-servers",
    "idle",
    "lambda-slow",
    "silent-agent",
    "underused",
}
PERIOD_S = 10
CHANGES_WITHIN_S = 240.0
"""LocalStack looks at an alarm once in all its periods together, here at most each 50 s."""
ONE_METRIC = re.compile(r"(?P<name>\w+)|IF\((?P<compared>\w+) >= (?P<threshold>[\d.]+), 1, 0\)")


class Server(FakeMachine):
    """A server under the load that the test sets, on the real clock; a busy one: full disk, no bucket."""

    def __init__(self) -> None:
        super().__init__()
        self._crashes = 0
        self.load(busy=False)

    def load(self, *, busy: bool) -> None:
        self._busy = busy
        robots, queue_s, disk_free_percent = (500, 5.0, 5.0) if busy else (1, 0.0, 50.0)
        self._crashes += busy
        self.text = (
            f"rse_pf_robots {robots}\nrse_pf_queue_oldest_s {queue_s}\n"
            f"rse_pf_worker_crashes {self._crashes}\nrse_pf_disk_free_percent {disk_free_percent}\n"
        )

    def reaches_store(self) -> bool:
        return not self._busy

    def clock(self) -> float:
        return time.monotonic()

    def wall_clock(self) -> float:
        return time.time()

    def cpu_times(self) -> tuple[float, float]:
        busy, there = self.cpu
        self.cpu = (busy + (99.0 if self._busy else 1.0), there + 100.0)
        return self.cpu


def alarms_in(template: dict[str, Any]) -> dict[str, dict[str, Any] | None]:
    """Return `of_one_metric` of the alarms of a template, by the part of the name after the prefix."""
    resources = template["Resources"]
    return {
        each["Properties"]["AlarmName"].rpartition("/")[2]: of_one_metric(each["Properties"], resources)
        for each in resources.values()
        if each["Type"] == "AWS::CloudWatch::Alarm"
    }


def of_one_metric(alarm: dict[str, Any], resources: dict[str, Any]) -> dict[str, Any] | None:
    """Return the arguments of PutMetricAlarm for an alarm of one metric, None if it needs more."""
    stats = {each["Id"]: each["MetricStat"] for each in alarm["Metrics"] if "MetricStat" in each}
    (verdict,) = (each["Expression"] for each in alarm["Metrics"] if "Expression" in each)
    found = ONE_METRIC.fullmatch(verdict)
    if len(stats) != 1 or found is None:
        return None
    (stat,) = stats.values()
    if stat["Stat"].startswith("p"):
        return None
    named = stat["Metric"].get("Dimensions", [])
    return {
        "Namespace": stat["Metric"]["Namespace"], "MetricName": stat["Metric"]["MetricName"],
        "Statistic": stat["Stat"], "Period": PERIOD_S,
        "Threshold": float(found["threshold"] or alarm["Threshold"]),
        "ComparisonOperator": alarm["ComparisonOperator"],
        "EvaluationPeriods": alarm["EvaluationPeriods"], "DatapointsToAlarm": alarm["DatapointsToAlarm"],
        "TreatMissingData": alarm["TreatMissingData"],
        "Dimensions": [{"Name": each["Name"], "Value": plain(each["Value"], resources)} for each in named],
    }  # fmt: skip


def plain(value: Any, resources: dict[str, Any]) -> str:
    """Return a name: of the group that is referenced, as the template gives it; another one is made up."""
    if isinstance(value, str):
        return value
    referenced = resources.get(value.get("Ref", ""), {}).get("Properties", {})
    return str(referenced.get("AutoScalingGroupName", "made-up"))


@pytest.mark.timeout(3 * CHANGES_WITHIN_S)
def test_each_alarm_of_the_templates_fires_and_resolves(deployment: Deployment) -> None:
    cloudwatch = make_client("cloudwatch", REGION)
    alarms = alarms_in(deployment.template("Backend")) | alarms_in(deployment.template("Observability"))
    simple = {name: rule for name, rule in alarms.items() if rule is not None}
    assert alarms.keys() - simple.keys() == NOT_EVALUATED
    server = Server()
    published = agent_of(server, cloudwatch)
    for name, rule in simple.items():
        cloudwatch.put_metric_alarm(AlarmName=f"short-{name}", **rule)

    def publish(busy: bool) -> None:
        server.load(busy=busy)
        published()
        for rule in simple.values():
            if rule["Namespace"] != NAMESPACE:  # what AWS publishes itself
                value = 2 * rule["Threshold"] if busy else 0.0
                told = {"MetricName": rule["MetricName"], "Dimensions": rule["Dimensions"], "Value": value}
                cloudwatch.put_metric_data(Namespace=rule["Namespace"], MetricData=[told])

    def become(state: str, *, busy: bool) -> None:
        until, found = time.monotonic() + CHANGES_WITHIN_S, dict[str, str]()
        while set(found.values()) != {state}:
            assert time.monotonic() < until, f"not {state}: {found}"
            publish(busy)
            threading.Event().wait(2.0)
            told = cloudwatch.describe_alarms(AlarmNamePrefix="short-")["MetricAlarms"]
            found = {each["AlarmName"]: each["StateValue"] for each in told}

    assert {"busy", "crowded"} <= {name for name, rule in simple.items() if rule["Namespace"] == NAMESPACE}
    become("ALARM", busy=True)
    become("OK", busy=False)


def agent_of(server: Server, cloudwatch: Any) -> Any:
    """Return what calls the tasks of the agent that publish the metrics of *server*."""
    config = AgentConfig(
        group="rse-pf",
        hook="drain",
        launch_hook="launch",
        keys_name="keys.json",
        keys_file=Path("keys.json"),
        state_folder=Path("state"),
    )
    context = AgentContext(
        machine=server, clients={"cloudwatch": cloudwatch}, artifacts=MemoryStore(), settings=SETTINGS,
        shipper=None, config=config, clock=server.clock, sleep=server.sleep, wall_clock=server.wall_clock,
        log=lambda event, **fields: None,
    )  # fmt: skip
    calls = [server_metrics.task(context).call, store_errors.task(context).call]

    def publish() -> None:
        for call in calls:
            call()

    return publish

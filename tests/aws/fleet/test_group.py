"""The state of the group: what AWS reports of each server, and None where no agent published a number."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import Account, open_account
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.fleet.group import AutoScalingGroup, Server, read_group
from rse_pf.aws.fleet.metrics import ServerMetrics, datums
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError
from rse_pf.extensions.fleet_page.feeds.cloud_metrics import read_group_metrics
from rse_pf.extensions.fleet_page.feeds.cloud_overview import read_overview
from rse_pf.scaling.alarms import NAMESPACE
from tests.kit.emulated_aws import REGION, emulated_aws
from tests.kit.fake_machine import FakeMachine, FakeScaling, agent_context

GROUP = ResourceNames().group
SETTINGS = PlatformSettings()
START = datetime.now(timezone.utc).replace(second=0, microsecond=0)
HOURS = itertools.count(1)
HEALTHY = Server(name="i-1", zone="a", state="InService", targets=("healthy",), robots=None)


@pytest.fixture(scope="module")
def region() -> Iterator[str]:
    """An emulated region that the tests of this module share."""
    with pytest.MonkeyPatch.context() as patch, emulated_aws(patch, __name__):
        yield REGION


@pytest.fixture
def now() -> datetime:
    """A minute of its own for each test, in which no other test has published anything."""
    return START - timedelta(hours=next(HOURS))


@pytest.fixture(scope="module")
def servers(region: str) -> list[str]:
    """Two instances in a group with one target group and one alarm."""
    account = open_account(region)
    ec2, elb = account.client("ec2"), account.client("elbv2")
    vpc = ec2.describe_vpcs()["Vpcs"][0]["VpcId"]
    targets = elb.create_target_group(Name="robots", Protocol="HTTP", Port=8765, VpcId=vpc)["TargetGroups"][0]
    subnets = [each["SubnetId"] for each in ec2.describe_subnets()["Subnets"]][:2]
    (balancer,) = elb.create_load_balancer(Name="rse-pf", Subnets=subnets, Type="network")["LoadBalancers"]
    elb.create_listener(
        LoadBalancerArn=balancer["LoadBalancerArn"], Protocol="TCP", Port=80,
        DefaultActions=[{"Type": "forward", "TargetGroupArn": targets["TargetGroupArn"]}],
    )  # fmt: skip
    image = ec2.describe_images()["Images"][0]["ImageId"]
    ec2.create_launch_template(
        LaunchTemplateName="servers", LaunchTemplateData={"ImageId": image, "InstanceType": "c7i.large"}
    )
    account.client("autoscaling").create_auto_scaling_group(
        AutoScalingGroupName=GROUP, MinSize=2, MaxSize=4, AvailabilityZones=[f"{region}a"],
        LaunchTemplate={"LaunchTemplateName": "servers", "Version": "$Latest"},
        TargetGroupARNs=[targets["TargetGroupArn"]],
    )  # fmt: skip
    account.client("cloudwatch").put_metric_alarm(
        AlarmName="rse-pf/busy", MetricName="m", Namespace="n", Statistic="Sum", Period=60, Threshold=1,
        EvaluationPeriods=1, ComparisonOperator="GreaterThanThreshold",
    )  # fmt: skip
    (group,) = account.client("autoscaling").describe_auto_scaling_groups()["AutoScalingGroups"]
    return sorted(each["InstanceId"] for each in group["Instances"])


def publish(region: str, server: str, robots: int, when: datetime) -> None:
    """Publish what an agent publishes, as of *when*."""
    reading = ServerMetrics(robots=robots)
    data = [{**datum, "Timestamp": when} for datum in datums(reading, reading, GROUP, server)]
    open_account(region).client("cloudwatch").put_metric_data(Namespace=NAMESPACE, MetricData=data)


def test_servers_and_alarms_are_shown_and_unknown_robots_are_not_zero(
    region: str, servers: list[str], now: datetime
) -> None:
    group = read_group(open_account(region), SETTINGS, now=now)

    assert (group.min_servers, group.wanted_servers, group.max_servers) == (2, 2, 4)
    assert [each.name for each in group.servers] == servers
    assert [each.robots for each in group.servers] == [None, None]
    assert group.robots == ()
    assert list(group.alarms) == ["busy"]
    assert all(len(each.targets) == 1 for each in group.servers)


def test_each_server_has_the_robots_that_its_agent_published_last(
    region: str, servers: list[str], now: datetime
) -> None:
    publish(region, servers[0], 99, now - timedelta(minutes=2.5))
    publish(region, servers[0], 12, now - timedelta(minutes=1))
    publish(region, servers[1], 30, now - timedelta(minutes=1))

    group = read_group(open_account(region), SETTINGS, now=now)

    assert [each.robots for each in group.servers] == [12, 30]
    assert group.robots == (12, 30)


def test_the_status_shows_what_a_running_agent_publishes(
    region: str, servers: list[str], tmp_path: Path
) -> None:
    machine = FakeMachine()
    machine.instance_id = lambda: servers[0]  # type: ignore[method-assign]
    machine.text = "rse_pf_robots 7\n"
    clients = {"cloudwatch": make_client("cloudwatch", region), "autoscaling": FakeScaling(machine)}
    agent = Agent(agent_context(machine, tmp_path, group=GROUP, clients=clients, settings=SETTINGS))
    agent.step()
    machine.sleep(60.0)
    agent.step()

    then = datetime.fromtimestamp(machine.wall_clock(), timezone.utc) + timedelta(minutes=1)
    group = read_group(open_account(region), SETTINGS, now=then)

    assert [each.robots for each in group.servers] == [7, None]


def test_the_current_period_is_left_out_so_that_no_server_is_missing_from_the_sum(
    region: str, servers: list[str], now: datetime
) -> None:
    for server, robots in zip(servers, (12, 30), strict=True):
        publish(region, server, robots, now - timedelta(minutes=1))
    publish(region, servers[0], 13, now)  # the other's agent comes later in this minute

    group = read_group(open_account(region), SETTINGS, now=now + timedelta(seconds=20))

    assert group.robots == (12, 30)


def test_a_number_older_than_three_periods_is_unknown(region: str, servers: list[str], now: datetime) -> None:
    publish(region, servers[0], 99, now - timedelta(minutes=5))

    assert read_group(open_account(region), SETTINGS, now=now).robots == ()


def test_the_overview_adds_balancer_ages_and_activities_and_asks_no_metric(
    region: str, servers: list[str], now: datetime
) -> None:
    publish(region, servers[0], 12, now - timedelta(minutes=1))

    told = read_overview(open_account(region), SETTINGS, now=now)

    assert told.balancer is not None
    assert (told.balancer.state, told.balancer.protocols) == ("active", ("TCP",))
    assert sorted(told.launched_s) == servers
    assert [each.robots for each in told.group.servers] == [None, None]
    assert told.problems == ()


def test_what_is_refused_beside_the_group_is_a_problem_and_not_an_error(
    region: str, servers: list[str], now: datetime
) -> None:
    class Denied(Account):
        def pages(self, service: str, method: str, rows: str, **arguments: Any) -> list[Any]:
            if service == "ec2":
                raise ConfigurationError("AWS refuses ec2 describe_instances: AccessDenied", hint="")
            return super().pages(service, method, rows, **arguments)

    told = read_overview(Denied(region), SETTINGS, now=now)

    assert told.problems == ("AWS refuses ec2 describe_instances: AccessDenied",)
    assert (told.launched_s, len(told.group.servers)) == ({}, 2)


def test_numbers_of_the_group_and_of_servers_are_read_in_one_request(
    region: str, servers: list[str], now: datetime, monkeypatch: pytest.MonkeyPatch
) -> None:
    give_moto_percentiles(monkeypatch)
    began, before = now - timedelta(minutes=2), ServerMetrics()
    for server, robots in zip(servers, (12, 30), strict=True):
        after = ServerMetrics(robots=robots, requests=600, bytes_in=3e6, answers={5.0: 18, 50.0: 20})
        data = [{**each, "Timestamp": began} for each in datums(before, after, GROUP, server)]
        open_account(region).client("cloudwatch").put_metric_data(Namespace=NAMESPACE, MetricData=data)

    told = read_group_metrics(open_account(region), SETTINGS, servers, now=now + timedelta(seconds=20))

    assert told.times_s[-1] == now.timestamp()
    assert told.times_s[0] == now.timestamp() - 59 * 60
    assert told.series["requests"][-2:] == (1200.0, None)
    assert told.newest("requests") == 1200.0
    assert (told.newest("p50_ms"), told.newest("p99_ms"), told.newest("answers")) == (5.0, 50.0, 40.0)
    assert told.servers == {servers[0]: {"robots": 12.0}, servers[1]: {"robots": 30.0}}
    assert told.newest("cpu_percent") is None


def test_the_page_of_the_cloud_needs_the_permissions_that_its_documentation_lists(
    region: str, servers: list[str], now: datetime, monkeypatch: pytest.MonkeyPatch, repository: Path
) -> None:
    give_moto_percentiles(monkeypatch)
    asked: set[str] = set()

    class Noting(Account):
        def find(self, service: str, method: str, **arguments: Any) -> dict[str, Any] | None:
            prefix = {"elbv2": "elasticloadbalancing"}.get(service, service)
            asked.add(f"{prefix}:{''.join(word.title() for word in method.split('_'))}")
            return super().find(service, method, **arguments)

    account = Noting(region)
    read_overview(account, SETTINGS, now=now)
    read_group_metrics(account, SETTINGS, servers, now=now)
    page = (repository / "docs" / "fleet_page.md").read_text("utf-8")
    (policy,) = re.findall(r"```json\n(.*?)```", page, flags=re.S)

    assert {action for each in json.loads(policy)["Statement"] for action in each["Action"]} == asked


def give_moto_percentiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the emulated CloudWatch know p50 to p99, as the real one does."""
    from moto.cloudwatch.models import Statistics

    plain = Statistics.get_statistics_for_type

    def statistic(self: Any, name: str) -> Any:
        values = sorted(self.metric_single_values_list)
        if not name.startswith("p"):
            return plain(self, name)
        return values[int(len(values) * float(name[1:]) / 100)] if values else None

    monkeypatch.setattr(Statistics, "get_statistics_for_type", statistic)


def test_without_a_platform_the_hint_says_to_deploy(region: str, now: datetime) -> None:
    with pytest.raises(ConfigurationError) as told:
        read_group(open_account("us-east-1"), SETTINGS, now=now)

    assert "rse-pf cloud up" in told.value.hint


@pytest.mark.parametrize(
    ("change", "healthy"),
    [
        ({}, True),
        ({"targets": ("healthy", "unhealthy")}, False),
        ({"targets": ()}, False),
        ({"state": "Terminating:Wait"}, False),
    ],
)
def test_a_group_is_healthy_when_all_wanted_servers_are_healthy_everywhere(
    change: dict[str, Any], healthy: bool
) -> None:
    group = AutoScalingGroup(
        min_servers=1,
        wanted_servers=1,
        max_servers=2,
        servers=(dataclasses.replace(HEALTHY, **change),),
        alarms={},
    )

    assert group.is_healthy is healthy

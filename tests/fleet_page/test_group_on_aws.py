"""What the page of a deployment reads from AWS about the group, its load balancer and its metrics."""

from __future__ import annotations

import json
import re
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import Account, open_account
from rse_pf.aws.fleet.metrics import ServerMetrics, datums
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.extensions.fleet_page.feeds.cloud_metrics import read_group_metrics
from rse_pf.extensions.fleet_page.feeds.cloud_overview import read_overview
from rse_pf.scaling.alarms import NAMESPACE
from tests.kit.emulated_group import GROUP, now, publish, region, servers

__all__ = ["now", "region", "servers"]
SETTINGS = PlatformSettings()


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

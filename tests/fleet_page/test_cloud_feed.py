"""The page of a deployment on AWS: what it makes of AWS's words, and what it says when AWS refuses."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
from typing import Any

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.group import AutoScalingGroup, Server
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, ConfigurationError
from rse_pf.extensions.fleet_page.cloud_page import serve_cloud_page
from rse_pf.extensions.fleet_page.feeds.cloud_feed import CloudFeed, cloud_document
from rse_pf.extensions.fleet_page.feeds.cloud_metrics import PERIODS, GroupMetrics
from rse_pf.extensions.fleet_page.feeds.cloud_overview import CloudBalancer, CloudOverview
from rse_pf.extensions.fleet_page.hub import Hub

SETTINGS = PlatformSettings()
NOW_S = 6000.0
HEALTHY = Server(name="i-1", zone="a", state="InService", targets=("healthy",), robots=None)


def overview(*servers: Server, wanted: int | None = None, **group: Any) -> CloudOverview:
    return CloudOverview(
        group=AutoScalingGroup(
            min_servers=1, wanted_servers=len(servers) if wanted is None else wanted, max_servers=4,
            servers=servers, alarms=group.pop("alarms", {"busy": "OK", "idle": "OK"}), **group,
        ),
        balancer=CloudBalancer(state="active", address="lb.example", protocols=("TLS",)),
        launched_s={"i-1": NOW_S - 90.0},
        activities=(),
    )  # fmt: skip


def metrics(cpu: tuple[float | None, ...], **servers: dict[str, float]) -> GroupMetrics:
    times_s = tuple(int(NOW_S) - 60 * back for back in range(PERIODS - 1, -1, -1))
    missing = (None,) * (PERIODS - len(cpu))
    return GroupMetrics(
        period_s=60, times_s=times_s, servers=servers,
        series={"cpu_percent": missing + cpu, "requests": (None,) * (PERIODS - 1) + (600.0,)},
    )  # fmt: skip


def test_the_boxes_show_what_aws_knows_and_say_what_it_does_not() -> None:
    second = dataclasses.replace(HEALTHY, name="i-2")
    numbers = metrics((20.0,), **{"i-1": {"robots": 7.0, "cpu_percent": 31.25}})

    reported = cloud_document(overview(HEALTHY, second), numbers, SETTINGS, time_s=NOW_S, region="r")

    assert [(each["name"], each["robots"], each["cpu_percent"]) for each in reported["servers"]] == [
        ("i-1", 7, 31.2), ("i-2", None, None),
    ]  # fmt: skip
    assert [each["age_s"] for each in reported["servers"]] == [90.0, None]
    assert (reported["robots"], reported["requests"], reported["percentiles"], reported["bytes_in"]) == (
        7,
        10.0,
        {},
        None,
    )
    assert (reported["tls"], reported["balancer"], reported["url"]) == (True, True, "lb.example")
    assert reported["unknown"][0] == "1 of 2 servers did not report their robots"
    assert json.loads(json.dumps(reported)) == reported


def test_an_alarm_and_a_missing_server_are_reported_with_the_runbook() -> None:
    alarmed = overview(HEALTHY, wanted=2, alarms={"silent": "ALARM"}, reasons={"silent": "no data\x1b"})

    reported = cloud_document(alarmed, metrics((30.0,)), SETTINGS, time_s=NOW_S)["waiting"]

    assert reported[0] == "the group wants 2 servers and has 1"
    assert reported[-1] == r"alarm silent is in state ALARM: no data\x1b (docs/operations.md#silent)"


class Refusing(Account):
    """An account whose credentials have expired."""

    def find(self, service: str, method: str, **arguments: Any) -> dict[str, Any] | None:
        raise ConfigurationError(f"AWS refuses {service} {method}: ExpiredToken", hint="sign in again")

    def pages(self, service: str, method: str, rows: str, **arguments: Any) -> list[Any]:
        if method == "get_metric_data":
            return [{"Id": "q0"}]  # as no answer of AWS is
        self.find(service, method)
        return []


def told_by_a_feed(account: Account) -> dict[str, Any]:
    hub, newest = Hub(), dict[str, Any]()
    feed = CloudFeed(hub, account, SETTINGS, overview(HEALTHY), wall_clock=lambda: NOW_S)

    async def listen() -> None:
        wanted = {"state", "metrics"}
        async with contextlib.aclosing(hub.messages(frozenset(("fleet", "link")))) as messages:
            async for message in messages:
                if message.startswith(b"data: "):
                    value = json.loads(message[6:])
                    newest[value["topic"]] = value["value"]
                    wanted -= set(problems_in(newest))
                if not wanted:
                    return

    async def both() -> None:
        running = asyncio.ensure_future(feed.run())
        try:
            await asyncio.wait_for(listen(), 10.0)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    asyncio.run(both())
    return newest


def problems_in(newest: dict[str, Any]) -> list[str]:
    fleet = newest.get("fleet", {})
    found = {
        "state": not newest.get("link", {}).get("connected", True),
        "metrics": any("not understood" in each for each in fleet.get("unknown", ())),
    }
    return [name for name, is_there in found.items() if is_there]


def test_credentials_that_expire_are_reported_on_the_page_and_end_nothing() -> None:
    reported = told_by_a_feed(Refusing("ap-northeast-2"))

    refused = "AWS refuses autoscaling describe_auto_scaling_groups: ExpiredToken (sign in again)"
    assert (reported["link"]["connected"], reported["link"]["text"]) == (False, refused)
    assert [each["name"] for each in reported["fleet"]["servers"]] == ["i-1"]


def test_wrong_credentials_are_an_error_before_a_page_is_served() -> None:
    with pytest.raises(ConfigurationError, match="ExpiredToken") as reported:
        serve_cloud_page(
            Refusing("ap-northeast-2"), SETTINGS, port=0,
            ready=lambda url: pytest.fail("it was served"),
        )  # fmt: skip
    assert reported.value.hint == "sign in again"


def test_the_page_of_the_cloud_changes_nothing() -> None:
    from rse_pf.extensions.fleet_page.cloud_page import _operate

    with pytest.raises(BadRequest, match="only shows"):
        asyncio.run(_operate("kill", {"server": "i-1"}))

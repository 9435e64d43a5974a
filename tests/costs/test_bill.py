"""What a load costs: line by line, the floor, parked, and on the Lambda."""

from __future__ import annotations

import msgspec
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.extensions.costs.bill import (
    Load,
    bill_of,
    parked,
    servers_needed,
)
from rse_pf.extensions.costs.prices import ServerPrice, load_prices

SETTINGS = PlatformSettings().replace(
    scaling={"min_servers": 2, "max_servers": 4, "busy_cpu_percent": 70.0}, cloud={"canary": False}
)
SMALL = PlatformSettings.from_dict({"cloud": {"profile": "small"}})
NOTHING = dict.fromkeys(
    ("volume_per_gb_month", "metric_per_month", "alarm_metric_per_month", "balancer_unit_per_hour",
     "firewall_per_month", "firewall_rule_per_month", "firewall_per_million", "secret_per_month",
     "lambda_per_gb_s", "alarm_fast_metric_per_month", "metric_calls_per_thousand"), 0.0,
)  # fmt: skip
PRICES = msgspec.structs.replace(
    load_prices(), **NOTHING,
    servers={"c7i.large": ServerPrice(vcpus=2, per_hour=0.1, spot_per_hour=0.04)},
    balancer_per_hour=0.01, address_per_hour=0.02, endpoint_per_hour=0.01, lambda_per_million=0.2,
    command_cpu_ms=7.0,
)  # fmt: skip
FLOOR = 730 * (0.01 + 2 * 0.02 + 4 * 0.01 + 2 * 0.1)
"""Balancer, two addresses, two endpoints in two zones, two servers."""


def at(robots: int, fps: float = 10.0, hours: float = 24.0) -> Load:
    return Load(robots=robots, fps=fps, hours_per_day=hours)


def test_a_bill_is_the_sum_of_its_lines_and_of_its_boxes_to_the_cent() -> None:
    spot, warm = SETTINGS.replace(cloud={"spot": True}), SETTINGS.replace(cloud={"warm_servers": 3})
    for settings in (PlatformSettings(), SMALL, spot, warm):
        bill = bill_of(settings, load_prices(), Load(robots=333, fps=7.7, hours_per_day=5.5))

        printed = [f"{line.count * line.price:.2f}" for line in bill.lines]
        assert f"{sum(map(float, printed)):.2f}" == f"{bill.total:.2f}"
        assert f"{sum(bill.sum_by_box().values()):.2f}" == f"{bill.total:.2f}"


def test_the_small_profile_costs_less_than_a_hundred_a_month_and_parked_less_than_twenty_five() -> None:
    bill = bill_of(SMALL, load_prices())

    assert 50 < bill.total < 100
    assert 0 < parked(bill, deep=True).total < 25
    assert parked(bill, deep=True).total < parked(bill, deep=False).total < bill.total


@pytest.mark.parametrize(
    ("settings", "load", "more"),
    [
        pytest.param(SETTINGS, at(1, fps=0.001), 0.0, id="the floor is paid when hardly anybody asks"),
        pytest.param(SETTINGS, at(60, hours=6.0), 0.1 * 730 / 4, id="further servers in the busy hours only"),
        pytest.param(
            SETTINGS.replace(cloud={"spot": True}), at(60),
            0.04 * 730 - 0.06 * 730, id="servers above the on-demand ones are Spot instances",
        ),
        pytest.param(
            SETTINGS, Load(robots=1, fps=0.001, burst_commands_per_day=24e6 / 730), 0.2,
            id="a million bursts on the Lambda",
        ),
    ],
)  # fmt: skip
def test_what_a_load_adds_to_the_floor(settings: PlatformSettings, load: Load, more: float) -> None:
    assert bill_of(settings, PRICES, load).total == pytest.approx(FLOOR + more, abs=0.011)


@pytest.mark.parametrize(("robots", "servers"), [(1, 2), (40, 2), (41, 3), (60, 3), (61, 4), (100, 5)])
def test_a_server_carries_commands_up_to_the_busy_threshold(robots: int, servers: int) -> None:
    # 2 vCPUs at 70 % do 200 commands of 7 ms a second: 20 of these robots.
    assert servers_needed(SETTINGS, PRICES, at(robots)) == servers

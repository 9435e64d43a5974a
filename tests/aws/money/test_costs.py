"""What a load costs: capacity, the floor, and the load from which the fleet is cheaper."""

from __future__ import annotations

import msgspec
import pytest

from rse_pf.aws.money.costs import Load, compare, crossing_commands_per_s, interface_endpoints
from rse_pf.aws.money.prices import Prices, load_prices
from rse_pf.config import PlatformSettings

SETTINGS = PlatformSettings().replace(scaling={"min_servers": 2, "max_servers": 4, "busy_cpu_percent": 70.0})
PRICES = msgspec.structs.replace(
    load_prices(),
    server_per_hour=0.1, server_vcpus=2, server_per_month=0.0, balancer_per_hour=0.01,
    balancer_unit_per_hour=0.0, endpoint_per_hour=0.01, fixed_per_month=10.0,
    lambda_per_million=0.2, lambda_per_gb_s=0.0, command_cpu_ms=7.0,
)  # fmt: skip
FLOOR = 10 + 730 * (0.01 + 6 * 0.01 + 2 * 0.1)
"""Fixed, balancer, three endpoints in two zones, two servers."""


def replaced(**values: float) -> Prices:
    return msgspec.structs.replace(PRICES, **values)


def at(robots: int, fps: float = 10.0, hours: float = 24.0) -> Load:
    return Load(robots=robots, fps=fps, hours_per_day=hours)


def test_the_floor_is_paid_when_hardly_anybody_asks() -> None:
    costs = compare(SETTINGS, PRICES, at(1, fps=0.001))

    assert costs.floor == pytest.approx(FLOOR)
    assert costs.fleet == pytest.approx(FLOOR)
    assert costs.serverless < 0.001


@pytest.mark.parametrize(("robots", "servers"), [(1, 2), (40, 2), (41, 3), (60, 3), (61, 4), (100, 5)])
def test_a_server_carries_commands_up_to_the_busy_threshold(robots: int, servers: int) -> None:
    # 2 vCPUs at 70 % do 200 commands of 7 ms a second: 20 of these robots.
    assert compare(SETTINGS, PRICES, at(robots)).servers == servers


def test_servers_beyond_the_floor_are_paid_in_the_busy_hours_only() -> None:
    assert compare(SETTINGS, PRICES, at(60, hours=6.0)).fleet == pytest.approx(FLOOR + 0.1 * 730 / 4)


def test_a_million_executions_cost_what_a_million_cost() -> None:
    million = at(1, fps=1e6 / (730 * 3600))

    assert compare(SETTINGS, PRICES, million).serverless == pytest.approx(0.2)


def test_the_lambda_is_billed_by_memory_and_by_the_millisecond() -> None:
    settings = SETTINGS.replace(cloud={"lambda_memory_mb": 2048})
    prices = replaced(lambda_per_million=0.0, lambda_per_gb_s=1e-5, command_cpu_ms=1.5)

    assert compare(settings, prices, at(1, fps=1.0)).serverless == pytest.approx(
        730 * 3600 * 2 * 0.002 * 1e-5
    )
    assert compare(settings, prices, at(1000, fps=1.0)).executions == pytest.approx(2.0)


def test_a_small_function_is_slower_and_billed_longer() -> None:
    small = SETTINGS.replace(cloud={"lambda_memory_mb": 885})

    assert compare(small, PRICES, at(100, fps=10.0)).executions == pytest.approx(14.0)


@pytest.mark.parametrize("hours", [24.0, 8.0])
def test_at_the_crossing_both_cost_the_same_and_before_it_the_lambda_less(hours: float) -> None:
    rate = crossing_commands_per_s(PlatformSettings(), load_prices(), 5.0, hours)
    assert rate is not None
    below, above = (
        compare(PlatformSettings(), load_prices(), Load(robots=1, fps=rate * factor, hours_per_day=hours))
        for factor in (0.98, 1.02)
    )

    assert below.serverless < below.fleet
    assert above.serverless > above.fleet


def test_a_lambda_that_is_nearly_free_is_never_crossed() -> None:
    assert crossing_commands_per_s(SETTINGS, replaced(lambda_per_million=0.001), 10.0) is None


def test_sockets_or_bytes_pay_the_balancers_units_whichever_is_more() -> None:
    dear = replaced(balancer_unit_per_hour=1.0, command_bytes=1000)

    by_sockets = compare(SETTINGS, dear, at(3000, fps=0.001)).fleet
    by_bytes = compare(SETTINGS, dear, at(1, fps=277.777778)).fleet

    assert by_sockets == pytest.approx(FLOOR + 730)
    assert by_bytes == pytest.approx(FLOOR + 730)


def test_the_profile_of_endpoints_counts() -> None:
    assert interface_endpoints(SETTINGS) == 6
    assert interface_endpoints(SETTINGS.replace(cloud={"endpoints": "full"})) == 10

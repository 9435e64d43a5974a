"""What a load costs: line by line, the floor, parked, and the load from which the fleet is cheaper."""

from __future__ import annotations

import msgspec
import pytest

from rse_pf.aws.money.costs import (
    Bill,
    CostLine,
    Load,
    bill_of,
    compare,
    crossing_commands_per_s,
    parked,
    parked_at_night,
)
from rse_pf.aws.money.prices import Prices, ServerPrice, load_prices
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError

SETTINGS = PlatformSettings().replace(
    scaling={"min_servers": 2, "max_servers": 4, "busy_cpu_percent": 70.0}, cloud={"canary": False}
)
SMALL = PlatformSettings.from_dict({"cloud": {"profile": "small"}})
NOTHING = dict.fromkeys(
    ("volume_per_gb_month", "metric_per_month", "alarm_metric_per_month", "balancer_unit_per_hour",
     "firewall_per_month", "firewall_rule_per_month", "firewall_per_million", "secret_per_month",
     "put_per_thousand", "lambda_per_gb_s", "alarm_fast_metric_per_month", "metric_calls_per_thousand"), 0.0,
)  # fmt: skip
PRICES = msgspec.structs.replace(
    load_prices(), **NOTHING,
    servers={"c7i.large": ServerPrice(vcpus=2, per_hour=0.1, spot_per_hour=0.04)},
    balancer_per_hour=0.01, address_per_hour=0.02, endpoint_per_hour=0.01, lambda_per_million=0.2,
    command_cpu_ms=7.0,
)  # fmt: skip
FLOOR = 730 * (0.01 + 2 * 0.02 + 4 * 0.01 + 2 * 0.1)
"""Balancer, two addresses, two endpoints in two zones, two servers."""


def replaced(**values: object) -> Prices:
    return msgspec.structs.replace(PRICES, **values)


def at(robots: int, fps: float = 10.0, hours: float = 24.0) -> Load:
    return Load(robots=robots, fps=fps, hours_per_day=hours)


def amounts(bill: Bill, box: str) -> float:
    return bill.sum_by_box().get(box, 0.0)


def test_the_floor_is_paid_when_hardly_anybody_asks() -> None:
    costs = compare(SETTINGS, PRICES, at(1, fps=0.001))

    assert costs.floor == pytest.approx(FLOOR)
    assert costs.fleet == pytest.approx(FLOOR)
    assert costs.serverless < 0.001


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


def test_parked_there_is_no_server_and_deep_no_load_balancer() -> None:
    bill = bill_of(PlatformSettings(), load_prices())
    shallow, deep = parked(bill, deep=False), parked(bill, deep=True)

    assert amounts(shallow, "backend servers") == 0
    assert amounts(shallow, "load balancer") == amounts(bill, "load balancer") > 0
    assert {"load balancer", "firewall"}.isdisjoint(deep.sum_by_box())
    assert set(deep.sum_by_box()) == {"monitor", "scale modifier", "data servers"}


def test_parked_at_night_costs_between_always_and_never() -> None:
    load = at(60, hours=6.0)
    bill = bill_of(SETTINGS, PRICES, load)

    night = parked_at_night(bill, load, deep=False)

    # Two servers for a quarter of the day, and the third one only then anyway.
    assert bill.total - night.total == pytest.approx(2 * 0.1 * 730 * 3 / 4)
    assert parked(bill, deep=True).total < parked_at_night(bill, load, deep=True).total < night.total


def test_servers_above_the_floor_of_on_demand_ones_are_spot_instances() -> None:
    spot = SETTINGS.replace(cloud={"spot": True, "on_demand_servers": 1})

    saved = bill_of(SETTINGS, PRICES).total - bill_of(spot, PRICES).total

    assert saved == pytest.approx(730 * 0.06)


def test_a_burst_is_answered_by_the_lambda_and_has_lines_of_its_own() -> None:
    quiet = bill_of(SETTINGS, PRICES, at(1, fps=0.001))
    burst = bill_of(SETTINGS, PRICES, Load(robots=1, fps=0.001, burst_commands_per_day=24e6 / 730))

    assert amounts(burst, "Lambda") == pytest.approx(0.2)
    assert burst.total == pytest.approx(quiet.total + 0.2)


def test_a_robot_hour_is_counted_in_the_hours_at_work() -> None:
    assert Load(robots=10, fps=5.0, hours_per_day=12.0).robot_hours == 3650.0


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


def test_the_lambda_alone_pays_for_a_command_what_a_burst_pays() -> None:
    prices = replaced(lambda_per_gb_s=1e-5, firewall_per_million=0.6)
    commands = 1e6
    every = Load(robots=1, fps=commands / (730 * 3600))
    burst = Load(robots=0, fps=0.0, burst_commands_per_day=commands * 24 / 730)

    lines = [line for line in bill_of(SETTINGS, prices, burst).lines if line.box == "Lambda"]

    assert {line.what.split()[0] for line in lines} == {"executions", "computing", "inspecting"}
    assert compare(SETTINGS, prices, every).serverless == pytest.approx(
        sum(each.amount for each in lines), abs=0.02
    )


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


def test_the_fast_profile_pays_for_its_alarms_and_for_six_times_as_many_requests() -> None:
    prices = replaced(
        metric_calls_per_thousand=1.0, alarm_metric_per_month=0.1, alarm_fast_metric_per_month=0.3
    )
    fast = SETTINGS.replace(scaling={"profile": "fast"})

    paper_requests, fast_requests = (
        {line.what: line.count for line in bill_of(settings, prices, at(1)).lines if line.unit == "thousand"}
        for settings in (SETTINGS, fast)
    )
    alarms = {line.what: line for line in bill_of(fast, prices).lines if line.what.startswith("alarms")}

    assert paper_requests["publishing metrics, always"] == pytest.approx(2 * 730 * 60 / 1e3)
    assert fast_requests["publishing metrics, always"] == pytest.approx(2 * 730 * 360 / 1e3)
    # Each agent reads the number of robots and that of servers.
    assert fast_requests["reading metrics of servers, in busy hours"] == pytest.approx(4 * 730 * 360 / 1e3)
    assert "alarms that scale" not in alarms
    assert alarms["alarms that scale, of 10 s"].price == 0.3


def test_nobody_reads_metrics_without_robots() -> None:
    prices = replaced(metric_calls_per_thousand=1.0)

    assert not [line for line in bill_of(SETTINGS, prices).lines if line.what.startswith("reading")]
    night = bill_of(SETTINGS, prices, at(1, hours=6.0))
    assert [line.count for line in night.lines if line.what.startswith("reading")] == [
        pytest.approx(4 * 730 / 4 * 60 / 1e3)
    ]


def test_job_servers_are_paid_by_the_hour_and_the_cheapest_known_type_is_taken() -> None:
    settings = SETTINGS.replace(
        cloud={"job_servers": 3, "job_instance_types": "z1d.large c7i.xlarge c7i.large"},
        serving={"offer_jobs": True, "job_poll_s": 5.0},
    )
    servers = {
        "c7i.large": ServerPrice(vcpus=2, per_hour=0.1, spot_per_hour=0.04),
        "c7i.xlarge": ServerPrice(vcpus=4, per_hour=0.2, spot_per_hour=0.08),
    }
    prices = replaced(servers=servers)

    resting = bill_of(settings, prices)
    at_work = bill_of(settings, prices, Load(robots=0, fps=0.0, job_hours_per_day=6.0))

    assert resting.total == pytest.approx(bill_of(SETTINGS, prices).total)
    assert at_work.total - resting.total == pytest.approx(0.04 * 730 / 4)
    assert [line.count for line in at_work.lines if line.what == "looks for jobs"] == [
        pytest.approx(730 / 4 * 720 / 1e3)
    ]


def test_a_group_of_job_servers_costs_its_alarms_and_metrics_at_rest() -> None:
    prices = replaced(metric_per_month=0.3, alarm_metric_per_month=0.1)
    with_jobs = SETTINGS.replace(cloud={"job_servers": 1}, serving={"offer_jobs": True})

    assert bill_of(with_jobs, prices).total - bill_of(SETTINGS, prices).total == pytest.approx(0.8)


def test_no_price_of_any_type_of_job_server_is_no_guess() -> None:
    settings = SETTINGS.replace(
        cloud={"job_servers": 1, "job_instance_types": "z1d.large"}, serving={"offer_jobs": True}
    )

    bill_of(settings, PRICES)
    with pytest.raises(ConfigurationError, match=r"no price of z1d\.large"):
        bill_of(settings, PRICES, Load(robots=0, fps=0.0, job_hours_per_day=1.0))


def test_an_unknown_type_of_server_has_no_price_and_no_guess() -> None:
    with pytest.raises(ConfigurationError, match=r"no price of z1d\.large") as caught:
        bill_of(SETTINGS.replace(cloud={"instance_type": "z1d.large"}), PRICES)

    assert "cloud prices --refresh" in caught.value.hint


def test_a_line_is_rounded_to_a_cent() -> None:
    assert CostLine(box="monitor", what="x", count=3, unit="h", price=0.0049).amount == 0.01

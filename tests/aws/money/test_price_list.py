"""Prices from the price list of AWS, played by products in the form that GetProducts documents."""

from __future__ import annotations

import json
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.money import price_list
from rse_pf.aws.money.price_list import document_of, refresh
from rse_pf.aws.money.prices import load_prices
from rse_pf.cli.main import main
from rse_pf.errors import ConfigurationError

NOW = datetime(2026, 11, 23, 9, 0, tzinfo=timezone.utc)
REGION = "eu-central-1"
AMOUNTS = {
    "EBS:VolumeUsage.gp3": 0.0952, "CW:MetricMonitorUsage": 0.3, "CW:AlarmMonitorUsage": 0.1,
    "CW:HighResAlarmMonitorUsage": 0.3, "CW:Requests": 1e-5,
    "LoadBalancerUsage": 0.027, "LCUUsage": 0.008, "PublicIPv4:InUseAddress": 0.005,
    "VpcEndpoint-Hours": 0.012, "WebACLV2": 5.0, "RuleV2": 1.0, "RequestV2-Tier1": 6e-7,
    "AWSSecretsManager-Secrets": 0.4, "TimedStorage-ByteHrs": 0.0245, "Requests-Tier1": 5.4e-6,
    "Request": 2e-7, "Lambda-GB-Second": 1.66667e-5, "BoxUsage:c7i.large": 0.1019,
}  # fmt: skip
"""End of a usage type to its price; the list names regions by a prefix."""


def product(usage: str, amount: float, **attributes: str) -> str:
    """Return one product as the list has it, with a dearer second tier and a reserved offer beside."""
    first = {"unit": "x", "beginRange": "0", "endRange": "10000", "pricePerUnit": {"USD": f"{amount:.10f}"}}
    second = {**first, "beginRange": "10000", "pricePerUnit": {"USD": "99"}}
    return json.dumps(
        {
            "product": {"attributes": {"usagetype": f"EUC1-{usage}", **attributes}},
            "terms": {
                "OnDemand": {"A": {"priceDimensions": {"A1": first, "A2": second}}},
                "Reserved": {"R": {"priceDimensions": {"R1": {**first, "pricePerUnit": {"USD": "1"}}}}},
            },
        }
    )


class PriceList(Account):
    """An account with a price list and Spot prices."""

    def __init__(self, products: list[str], spot: list[tuple[str, float]] = ()) -> None:  # type: ignore[assignment]
        super().__init__(REGION)
        self.products = products
        self.asked: list[dict[str, Any]] = []
        self._spot = spot

    def pages(self, service: str, method: str, rows: str, **arguments: Any) -> list[Any]:
        assert (service, method, rows) == ("pricing", "get_products", "PriceList")
        self.asked.append(arguments)
        return self.products

    def find(self, service: str, method: str, **arguments: Any) -> dict[str, Any] | None:
        assert (service, method) == ("ec2", "describe_spot_price_history")
        rows = [
            {"AvailabilityZone": zone, "SpotPrice": str(price), "Timestamp": NOW}
            for zone, price in self._spot
        ]
        return {"SpotPriceHistory": rows}


def everything() -> list[str]:
    return [
        product(usage, amount, **({"vcpu": "2"} if usage.startswith("Box") else {}))
        for usage, amount in AMOUNTS.items()
    ]


def refreshed(products: list[str], spot: list[tuple[str, float]] = ()) -> Any:  # type: ignore[assignment]
    account = PriceList(products, spot)
    return refresh(
        load_prices(), ("c7i.large",), region=REGION, price_list=account, account=account, now=NOW
    )  # fmt: skip


def test_every_price_is_replaced_dated_and_verified() -> None:
    prices = refreshed(everything(), [("a", 0.04), ("b", 0.06)])

    assert (prices.as_of, prices.region, prices.unverified) == ("2026-11-23", REGION, ())
    assert prices.servers["c7i.large"].per_hour == 0.1019
    assert prices.servers["c7i.large"].spot_per_hour == pytest.approx(0.05)
    assert prices.balancer_per_hour == 0.027
    assert (prices.lambda_per_million, prices.put_per_thousand) == pytest.approx((0.2, 0.0054))
    assert prices.warnings(today=NOW.date(), region=REGION) == []
    assert set(prices.servers) == {"c7i.large"}, "prices of another region do not stay"


def test_only_products_of_the_region_are_asked_for() -> None:
    account = PriceList(everything())

    refresh(load_prices(), ("c7i.large",), region=REGION, price_list=account, account=account, now=NOW)

    wanted = {"Type": "TERM_MATCH", "Field": "regionCode", "Value": REGION}
    assert all(wanted in asked["Filters"] for asked in account.asked)


def test_a_price_that_is_missing_or_ambiguous_stays_and_is_named() -> None:
    products = [each for each in everything() if "WebACLV2" not in each]
    prices = refreshed([*products, product("VpcEndpoint-Hours", 0.02)])

    assert prices.unverified == ("endpoint_per_hour", "firewall_per_month")
    assert prices.firewall_per_month == load_prices().firewall_per_month
    (warning,) = prices.warnings(today=NOW.date(), region=REGION)
    assert "endpoint_per_hour, firewall_per_month were not read" in warning


def test_a_list_without_the_region_is_an_error_and_not_a_file_of_old_prices() -> None:
    with pytest.raises(ConfigurationError, match="no price of eu-central-1"):
        refreshed([])


def test_the_file_that_is_written_is_the_file_that_is_read(tmp_path: Path) -> None:
    prices = refreshed(everything())
    file = tmp_path / "prices.json"
    file.write_bytes(document_of(prices))

    assert load_prices(file).balancer_per_hour == prices.balancer_per_hour
    assert load_prices(file).unverified == ()


def test_the_verb_refreshes_the_file_that_cost_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    account = PriceList(everything(), [("a", 0.05)])
    asked: list[str] = []
    monkeypatch.setattr("rse_pf.aws.account.open_account", lambda region: asked.append(region) or account)
    context = {"rse-pf": {"cloud": {"region": REGION, "s3_prefix_list": "pl-1"}}}
    (tmp_path / "cdk.json").write_text(json.dumps({"context": context}), encoding="utf-8")

    assert main(["cloud", "prices"]) == 1
    assert "UNVERIFIED" in capsys.readouterr().out
    assert main(["cloud", "prices", "--refresh"]) == 0
    assert asked == [price_list.PRICE_LIST_REGION, REGION]
    assert "wrote prices.json" in capsys.readouterr().out
    assert main(["cloud", "cost"]) == 0
    assert "UNVERIFIED" not in capsys.readouterr().out

"""Read prices from the price list of AWS, so that an estimate is of the operator's own region and day.

Reads only.  A price that the list lacks, or has with several amounts, keeps the old value and is named in
``unverified``; nothing is guessed.

Source:
    AWS Price List Query API, GetProducts; Spot prices from EC2, DescribeSpotPriceHistory.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date, datetime, timezone
from typing import Any

import msgspec

from rse_pf.aws.account import Account
from rse_pf.aws.money.prices import Prices, ServerPrice
from rse_pf.errors import ConfigurationError

__all__ = ["PRICE_LIST_REGION", "SOURCE", "document_of", "refresh"]

PRICE_LIST_REGION = "us-east-1"
"""The price list of all regions is asked here; few regions have it."""
SOURCE = "the price list of AWS, by rse-pf cloud prices --refresh"
_FORMAT = "aws_v1"


@dataclass(frozen=True, slots=True)
class _Question:
    """One price: the service, attributes of the product, and the end of its usage type.

    ``times`` turns the unit of AWS into ours, such as one request into a million.
    """

    name: str
    service: str
    attributes: Mapping[str, str]
    usage: str
    times: float = 1.0


_QUESTIONS = (
    _Question("volume_per_gb_month", "AmazonEC2", {"volumeApiName": "gp3"}, r"EBS:VolumeUsage\.gp3"),
    _Question("metric_per_month", "AmazonCloudWatch", {"productFamily": "Metric"}, r"CW:MetricMonitorUsage"),
    _Question(
        "alarm_metric_per_month", "AmazonCloudWatch", {"productFamily": "Alarm"}, r"CW:AlarmMonitorUsage"
    ),
    _Question(
        "alarm_fast_metric_per_month",
        "AmazonCloudWatch",
        {"productFamily": "Alarm"},
        r"CW:HighResAlarmMonitorUsage",
    ),
    _Question(
        "metric_calls_per_thousand", "AmazonCloudWatch", {"productFamily": "API Request"}, r"CW:Requests", 1e3
    ),
    _Question(
        "balancer_per_hour", "AWSELB", {"productFamily": "Load Balancer-Application"}, "LoadBalancerUsage"
    ),
    _Question("balancer_unit_per_hour", "AWSELB", {"productFamily": "Load Balancer-Application"}, "LCUUsage"),
    _Question("address_per_hour", "AmazonVPC", {"group": "VPCPublicIPv4Address"}, "PublicIPv4:InUseAddress"),
    _Question("endpoint_per_hour", "AmazonVPC", {"productFamily": "VpcEndpoint"}, "VpcEndpoint-Hours"),
    _Question("firewall_per_month", "awswaf", {"productFamily": "Web Application Firewall"}, "WebACLV2"),
    _Question("firewall_rule_per_month", "awswaf", {"productFamily": "Web Application Firewall"}, "RuleV2"),
    _Question(
        "firewall_per_million",
        "awswaf",
        {"productFamily": "Web Application Firewall"},
        "RequestV2-Tier1",
        1e6,
    ),
    _Question("secret_per_month", "AWSSecretsManager", {}, "AWSSecretsManager-Secrets"),
    _Question("stored_per_gb_month", "AmazonS3", {"productFamily": "Storage"}, "TimedStorage-ByteHrs"),
    _Question("put_per_thousand", "AmazonS3", {"group": "S3-API-Tier1"}, "Requests-Tier1", 1e3),
    _Question("lambda_per_million", "AWSLambda", {"group": "AWS-Lambda-Requests"}, "Request", 1e6),
    _Question("lambda_per_gb_s", "AWSLambda", {"group": "AWS-Lambda-Duration"}, "Lambda-GB-Second"),
)
_SERVER = {
    "operatingSystem": "Linux", "tenancy": "Shared", "preInstalledSw": "NA", "capacitystatus": "Used",
}  # fmt: skip


def refresh(
    old: Prices, instance_types: tuple[str, ...], *, region: str, price_list: Account, account: Account,
    now: datetime,
) -> Prices:  # fmt: skip
    """Return the prices of *region* today; what the list does not hold keeps its *old* value.

    Args:
        old: The prices so far, of any region.
        instance_types: The EC2 types whose prices are read.
        region: Of the deployment.
        price_list: An account at `PRICE_LIST_REGION`.
        account: The account at *region*, for the prices of Spot instances.
        now: The time in UTC.

    Raises:
        ConfigurationError: AWS refused; the permissions pricing:GetProducts and
            ec2:DescribeSpotPriceHistory are needed.
        StoreError: AWS does not answer.
    """
    changes: dict[str, float] = {}
    unverified: list[str] = []
    for question in _QUESTIONS:
        price = _read_price(price_list, question, region)
        if price is None:
            unverified.append(question.name)
        else:
            changes[question.name] = price * question.times
    servers = dict(old.servers) if old.region == region else {}
    for kind in instance_types:
        server = _read_server_price(price_list, account, kind, region, now)
        if isinstance(server, ServerPrice):
            servers[kind] = server
        else:
            unverified.append(f"servers.{kind}")
            if kind in old.servers:
                servers[kind] = old.servers[kind]
    unverified += sorted(f"servers.{kind}" for kind in servers.keys() - set(instance_types))
    if len(unverified) == len(_QUESTIONS) + len(servers):
        raise ConfigurationError(
            f"the price list of AWS has no price of {region}", hint="check cloud.region in cdk.json"
        )
    return msgspec.structs.replace(
        old, **changes, servers=servers, region=region, as_of=now.date().isoformat(), source=SOURCE,
        unverified=tuple(unverified),
    )  # fmt: skip


def document_of(prices: Prices) -> bytes:
    """Return *prices* as the content of a file that `rse_pf.aws.money.prices.load_prices` reads."""
    return msgspec.json.format(msgspec.json.encode(prices), indent=2) + b"\n"


def _read_server_price(
    price_list: Account, account: Account, kind: str, region: str, now: datetime
) -> ServerPrice | None:
    question = _Question(kind, "AmazonEC2", {**_SERVER, "instanceType": kind}, rf"BoxUsage:{re.escape(kind)}")
    products = _read_products(price_list, question, region)
    per_hour = _single_price(products)
    vcpus = {str(product["product"]["attributes"].get("vcpu", "")) for product in products}
    if per_hour is None or len(vcpus) != 1 or not (count := vcpus.pop()).isdigit():
        return None
    spot = _read_spot_price(account, kind, now)
    return ServerPrice(vcpus=int(count), per_hour=per_hour, spot_per_hour=per_hour if spot is None else spot)


def _read_spot_price(account: Account, kind: str, now: datetime) -> float | None:
    """Return the newest Spot price, the mean of the zones; None where the type is not sold so."""
    rows = account.find(
        "ec2", "describe_spot_price_history", InstanceTypes=[kind], ProductDescriptions=["Linux/UNIX"],
        StartTime=now,
    )  # fmt: skip
    newest: dict[str, tuple[datetime, float]] = {}
    for row in (rows or {}).get("SpotPriceHistory", ()):
        if float(row["SpotPrice"]) > 0:
            dated_price = (row["Timestamp"], float(row["SpotPrice"]))
            newest[row["AvailabilityZone"]] = max(dated_price, newest.get(row["AvailabilityZone"], _NEVER))
    return sum(price for _, price in newest.values()) / len(newest) if newest else None


_NEVER = (datetime.combine(date.min, datetime.min.time(), tzinfo=timezone.utc), 0.0)


def _read_price(price_list: Account, question: _Question, region: str) -> float | None:
    return _single_price(_read_products(price_list, question, region))


def _read_products(price_list: Account, question: _Question, region: str) -> list[dict[str, Any]]:
    """Return the products of *region* whose usage type ends as asked; some price lists name no region."""
    filters = {"regionCode": region, **question.attributes}
    rows = price_list.pages(
        "pricing", "get_products", "PriceList", ServiceCode=question.service, FormatVersion=_FORMAT,
        Filters=[{"Type": "TERM_MATCH", "Field": name, "Value": value} for name, value in filters.items()],
    )  # fmt: skip
    usage = re.compile(rf"(?:[A-Z0-9]+-)?{question.usage}")
    products = []
    for row in rows:
        product: dict[str, Any] = json.loads(row)
        attributes = product["product"]["attributes"]
        if usage.fullmatch(str(attributes.get("usagetype", ""))):
            products.append(product)
    return products


def _single_price(products: list[dict[str, Any]]) -> float | None:
    """Return the on-demand price of the first tier in USD; None if there is none, or more than one."""
    amounts = {amount for product in products for amount in _first_tier_prices(product)}
    return amounts.pop() if len(amounts) == 1 else None


def _first_tier_prices(product: dict[str, Any]) -> Iterator[float]:
    for offer in product.get("terms", {}).get("OnDemand", {}).values():
        for tier in offer["priceDimensions"].values():
            amount = float(tier["pricePerUnit"].get("USD", "nan"))
            if float(tier.get("beginRange") or 0) == 0 and amount > 0:
                yield amount

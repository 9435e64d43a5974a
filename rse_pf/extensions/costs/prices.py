"""Read the prices for an estimate of costs: one dated table for one region, without taxes.

`rse_pf/extensions/costs/prices.json` holds the table of the release.  A file ``prices.json`` in the folder of
cdk.json, or the file of ``rse-pf cloud cost --prices FILE``, replaces some or all of its values; it should
also state its own ``as_of``, ``region`` and ``source``.
"""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Annotated, Any

import msgspec

from rse_pf.errors import ConfigurationError

__all__ = ["PRICES_FILE", "STALE_DAYS", "Prices", "ServerPrice", "load_prices", "operators_prices"]

# Name of the file in the folder of cdk.json with which an operator replaces prices.
PRICES_FILE = "prices.json"
# Age in days above which a warning calls prices stale: AWS changes some prices every year.
STALE_DAYS = 365

# File with the prices of the release.
_TABLE_OF_THE_RELEASE = Path(__file__).with_name("prices.json")

_Price = Annotated[float, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
_Count = Annotated[int, msgspec.Meta(ge=1)]


class ServerPrice(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Number of vCPUs and prices of an EC2 instance type; Spot prices change from hour to hour."""

    vcpus: _Count
    per_hour: _Price
    spot_per_hour: _Price


class Prices(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of prices in the currency *currency*, and the measured costs of a command.

    Attributes:
        as_of: Day on which these prices were valid, ``YYYY-MM-DD``.
        region: AWS region for which they are valid.
        currency: Currency of all prices, such as ``USD``.
        source: Where the prices were read, and by whom.
        servers: Prices of EC2 instances, by instance type.
        volume_per_gb_month: Price of one GB of a gp3 volume for a month.
        metric_per_month: Price of one detailed or custom CloudWatch metric for a month.
        alarm_metric_per_month: Price of one metric in an alarm of standard resolution for a month.
        alarm_fast_metric_per_month: Price of one metric in an alarm with a period below a minute.
        metric_calls_per_thousand: Price of a thousand requests that publish metrics, or of metrics read.
        balancer_per_hour: Price of the load balancer for an hour, without its addresses.
        balancer_unit_per_hour: Price of one capacity unit for an hour: 3000 connections, or 1 GB an hour.
        address_per_hour: Price of one public IPv4 address for an hour.
        endpoint_per_hour: Price of one interface endpoint in one zone for an hour.
        firewall_per_month: Price of one web ACL for a month.
        firewall_rule_per_month: Price of one rule of a web ACL for a month.
        firewall_per_million: Price of a million requests that the web ACL inspects.
        secret_per_month: Price of one secret for a month.
        stored_per_gb_month: Price of one GB in S3 standard storage for a month.
        lambda_per_million: Price of a million executions of a Lambda function.
        lambda_per_gb_s: Price of one GB of memory of a Lambda function for a second, x86-64.
        command_cpu_ms: Measured CPU time, ms, of a PnP command with the work of its WebSocket connection.
        command_bytes: Measured size, bytes, of the message of a PnP command with 200 matches in ``zlib``.
    """

    as_of: Annotated[str, msgspec.Meta(pattern=r"^\d{4}-\d{2}-\d{2}$")]
    region: str
    currency: str
    source: str
    servers: dict[str, ServerPrice]
    volume_per_gb_month: _Price
    metric_per_month: _Price
    alarm_metric_per_month: _Price
    alarm_fast_metric_per_month: _Price
    metric_calls_per_thousand: _Price
    balancer_per_hour: _Price
    balancer_unit_per_hour: _Price
    address_per_hour: _Price
    endpoint_per_hour: _Price
    firewall_per_month: _Price
    firewall_rule_per_month: _Price
    firewall_per_million: _Price
    secret_per_month: _Price
    stored_per_gb_month: _Price
    lambda_per_million: _Price
    lambda_per_gb_s: _Price
    command_cpu_ms: _Positive
    command_bytes: _Count

    def server(self, instance_type: str) -> ServerPrice:
        """Return the price of an EC2 type; raises ConfigurationError if the table has none."""
        price = self.servers.get(instance_type)
        if price is None:
            raise ConfigurationError(
                f"no price of {instance_type} is known; the table has {', '.join(sorted(self.servers))}",
                hint=f"add it to servers in {PRICES_FILE} next to cdk.json: vcpus, per_hour, spot_per_hour",
            )
        return price

    def warnings(self, *, today: date, region: str) -> list[str]:
        """Return lines that warn of prices that are too old *today*, or of another region than *region*.

        Empty if the prices are valid.
        """
        lines = []
        days = (today - date.fromisoformat(self.as_of)).days
        if days > STALE_DAYS:
            lines.append(f"STALE: these prices are {days} days old, more than {STALE_DAYS}")
        if self.region != region:
            lines.append(f"WRONG REGION: these prices are for {self.region}, and cloud.region is {region}")
        if lines:
            lines.append(f"write the prices of your region into {PRICES_FILE} next to cdk.json")
        return lines


def load_prices(over: Path | None = None) -> Prices:
    """Return the prices of the release; values in the file *over* replace those of the release.

    Raises:
        ConfigurationError: *over* cannot be read, is not a JSON object, or holds an unknown name or an
            invalid value.
    """
    values: dict[str, Any] = msgspec.json.decode(_TABLE_OF_THE_RELEASE.read_bytes())
    if over is None:
        return msgspec.convert(values, Prices)
    try:
        overrides = msgspec.json.decode(over.read_bytes(), type=dict[str, Any])
        servers = overrides.get("servers")
        if isinstance(servers, dict):
            overrides["servers"] = values["servers"] | servers
        prices = msgspec.convert(values | overrides, Prices)
        date.fromisoformat(prices.as_of)
    except OSError as error:
        raise ConfigurationError(
            f"cannot read {over}: {error.strerror}", hint="name an existing file with --prices"
        ) from error
    except (ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors, too
        raise ConfigurationError(
            f"{over} holds no prices: {error}",
            hint=f"write a JSON object with some of these names: {', '.join(values)}",
        ) from error
    return prices


def operators_prices(path: Path | None, folder: Path) -> Prices:
    """Return the prices in the file *path*, else in `PRICES_FILE` of *folder*, else those of the release.

    Raises:
        ConfigurationError: The file is invalid, see `load_prices`.
    """
    own = folder / PRICES_FILE
    return load_prices(path or (own if own.exists() else None))

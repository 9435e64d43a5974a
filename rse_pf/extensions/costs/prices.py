"""The prices that an estimate is made from: one dated table for one region, without taxes.

`rse_pf/extensions/costs/prices.json` holds the table of the release.  A file ``prices.json`` in the folder of
cdk.json, or ``rse-pf cloud cost --prices FILE``, replaces all prices or some; it should also name its own
``as_of``, ``region`` and ``source``.
"""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Annotated, Any

import msgspec

from rse_pf.errors import ConfigurationError

__all__ = ["PRICES_FILE", "STALE_DAYS", "Prices", "ServerPrice", "load_prices", "operators_prices"]

# Name of the operator's own table, in the folder of cdk.json.
PRICES_FILE = "prices.json"
# Prices that are older than this many days are called stale: AWS changes some of them every year.
STALE_DAYS = 365

_TABLE_OF_THE_RELEASE = Path(__file__).with_name("prices.json")

_Price = Annotated[float, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
_Count = Annotated[int, msgspec.Meta(ge=1)]


class ServerPrice(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One EC2 type; the price of a Spot instance changes from hour to hour."""

    vcpus: _Count
    per_hour: _Price
    spot_per_hour: _Price


class Prices(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The table; amounts are in `currency`.

    Attributes:
        as_of: The day on which these prices held.
        source: Where the prices were read, and by whom.
        servers: By EC2 type.
        volume_per_gb_month: Of a gp3 volume.
        metric_per_month: One detailed or custom metric.
        alarm_metric_per_month: One metric in an alarm of standard resolution.
        alarm_fast_metric_per_month: One metric in an alarm with a period below a minute.
        metric_calls_per_thousand: A thousand requests that publish metrics, or metrics that are read.
        balancer_per_hour: The load balancer without its addresses.
        balancer_unit_per_hour: One capacity unit: 3000 connections, or 1 GB an hour.
        address_per_hour: One public IPv4 address.
        endpoint_per_hour: One interface endpoint in one zone.
        firewall_per_month: One web ACL.
        firewall_rule_per_month: One rule of it.
        firewall_per_million: A million requests that the web ACL inspects.
        secret_per_month: One secret.
        stored_per_gb_month: One GB in S3, standard storage.
        lambda_per_million: A million executions.
        lambda_per_gb_s: A gigabyte of memory for a second, x86-64.
        command_cpu_ms: CPU time of a PnP command, its socket included; measured.
        command_bytes: One PnP command on the wire: 200 matches, zlib; measured.
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
        """Return what is wrong with these prices for an estimate of today in *region*."""
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
    """Return the table of the release with the values of the file *over* in place of its own.

    Raises:
        ConfigurationError: *over* is not readable, is not a JSON object, or holds a value that is no price.
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
        ConfigurationError: As `load_prices`.
    """
    own = folder / PRICES_FILE
    return load_prices(path or (own if own.exists() else None))

"""The prices that an estimate is made from: a dated file for one region, without taxes.

`rse_pf/aws/money/prices.json` holds the defaults, which nobody checked; ``rse-pf cloud prices --refresh``
writes a file of the operator from the price list of AWS, and ``rse-pf cloud cost --prices FILE`` takes any.
"""

from __future__ import annotations

import re
from datetime import date
from pathlib import Path
from typing import Annotated, Any

import msgspec

from rse_pf.errors import ConfigurationError

__all__ = ["EVERY", "PRICES_FILE", "STALE_DAYS", "Prices", "ServerPrice", "load_prices", "operators_prices"]

PRICES_FILE = "prices.json"
"""Of the operator, in the folder of cdk.json; ``rse-pf cloud prices --refresh`` writes it."""
STALE_DAYS = 90
"""Prices that are older are told as stale."""
EVERY = "*"
"""In ``unverified``: no price of the file was checked."""

_OURS = Path(__file__).with_name("prices.json")

_Price = Annotated[float, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
_Count = Annotated[int, msgspec.Meta(ge=1)]


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A part of the file; unknown names are refused."""


class ServerPrice(_Table, frozen=True, kw_only=True):
    """One type of server."""

    vcpus: _Count
    per_hour: _Price
    """On demand."""
    spot_per_hour: _Price
    """Of a Spot instance, which changes from hour to hour."""


class Prices(_Table, frozen=True, kw_only=True):
    """One dated table; amounts are in `currency`."""

    as_of: Annotated[str, msgspec.Meta(pattern=r"^\d{4}-\d{2}-\d{2}$")]
    """The day on which these prices held."""
    region: str
    currency: str
    source: str
    """Where the prices were read, and by whom."""
    unverified: tuple[str, ...] = ()
    """Names of prices that were not read from the price list; `EVERY` for all."""
    servers: dict[str, ServerPrice]
    """By EC2 type."""
    volume_per_gb_month: _Price
    """gp3."""
    metric_per_month: _Price
    """One detailed or custom metric."""
    alarm_metric_per_month: _Price
    """One metric in an alarm of standard resolution."""
    alarm_fast_metric_per_month: _Price
    """One metric in an alarm with a period below a minute."""
    metric_calls_per_thousand: _Price
    """A thousand requests that publish metrics, or metrics that are read."""
    balancer_per_hour: _Price
    """The load balancer without its addresses."""
    balancer_unit_per_hour: _Price
    """One capacity unit: 3000 connections, or 1 GB an hour."""
    address_per_hour: _Price
    """One public IPv4 address."""
    endpoint_per_hour: _Price
    """One interface endpoint in one zone."""
    firewall_per_month: _Price
    """One web ACL."""
    firewall_rule_per_month: _Price
    firewall_per_million: _Price
    """A million requests that the web ACL inspects."""
    secret_per_month: _Price
    stored_per_gb_month: _Price
    """One GB in S3, standard storage."""
    put_per_thousand: _Price
    """A thousand objects written to S3."""
    lambda_per_million: _Price
    """A million executions."""
    lambda_per_gb_s: _Price
    """A gigabyte of memory for a second, x86-64."""
    command_cpu_ms: _Positive
    """CPU time of a PnP command on a server or in the Lambda, its socket included; measured."""
    command_bytes: _Count
    """One PnP command on the wire: 200 matches, zlib; measured."""

    def server(self, instance_type: str) -> ServerPrice:
        """Return the price of an EC2 type; raises ConfigurationError if the file has none."""
        price = self.servers.get(instance_type)
        if price is None:
            raise ConfigurationError(
                f"no price of {instance_type} is known; the file has {', '.join(sorted(self.servers))}",
                hint="run rse-pf cloud prices --refresh, or give the price with --prices FILE",
            )
        return price

    def vcpus(self, instance_type: str) -> int:
        """Return the vCPUs of an EC2 type, by its size where the file does not have the type."""
        price = self.servers.get(instance_type)
        size = re.search(r"\.(\d*)xlarge$", instance_type)
        return price.vcpus if price else 4 * int(size[1] or 1) if size else 2

    def warnings(self, *, today: date, region: str) -> list[str]:
        """Return what is wrong with these prices for an estimate of today in *region*."""
        lines = []
        if self.unverified:
            whose = "these prices" if EVERY in self.unverified else f"the prices {', '.join(self.unverified)}"
            lines.append(f"UNVERIFIED: {whose} were not read from AWS: rse-pf cloud prices --refresh")
        days = (today - date.fromisoformat(self.as_of)).days
        if days > STALE_DAYS:
            lines.append(
                f"STALE: these prices are {days} days old, more than {STALE_DAYS}: "
                "rse-pf cloud prices --refresh"
            )
        if self.region != region:
            lines.append(
                f"WRONG REGION: these prices are for {self.region}, and cloud.region is {region}: "
                "rse-pf cloud prices --refresh"
            )
        return lines


def load_prices(over: Path | None = None) -> Prices:
    """Return our prices with the values of the file *over* in place of ours.

    Raises:
        ConfigurationError: *over* is not readable, is not a JSON object, or holds a value that is no price.
    """
    values: dict[str, Any] = msgspec.json.decode(_OURS.read_bytes())
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
    """Return the prices in the file *path*, else in `PRICES_FILE` of *folder* if there is one, else ours.

    Raises:
        ConfigurationError: As `load_prices`.
    """
    if path is not None:
        return load_prices(path)
    own = folder / PRICES_FILE
    return load_prices(own if own.exists() else None)

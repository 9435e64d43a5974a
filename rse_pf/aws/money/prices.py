"""The prices that an estimate is made from: a dated file for one region, without taxes.

`rse_pf/aws/money/prices.json` holds the defaults; ``rse-pf cloud cost --prices FILE`` replaces them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec

from rse_pf.errors import ConfigurationError

__all__ = ["Prices", "load_prices"]

_OURS = Path(__file__).with_name("prices.json")

_Price = Annotated[float, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]
_Count = Annotated[int, msgspec.Meta(ge=1)]


class Prices(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One dated table; amounts are in `currency`."""

    as_of: str
    """When these prices held."""
    region: str
    currency: str
    source: str
    """Where the prices were read, and by whom."""
    instance_type: str
    """The type of server that the prices of a server are for."""
    server_vcpus: _Count
    server_per_hour: _Price
    """One server, on demand."""
    server_per_month: _Price
    """Cost of a server beside its hours: 8 GB of gp3, seven detailed metrics and one of ours."""
    balancer_per_hour: _Price
    """The load balancer with two public addresses."""
    balancer_unit_per_hour: _Price
    """One capacity unit: 3000 connections, or 1 GB an hour."""
    endpoint_per_hour: _Price
    """One interface endpoint in one zone."""
    fixed_per_month: _Price
    """WAF with one rule, alarms, our metrics and one secret."""
    lambda_per_million: _Price
    """A million executions."""
    lambda_per_gb_s: _Price
    """A gigabyte of memory for a second, x86-64."""
    command_cpu_ms: _Positive
    """CPU time of a PnP command on a server or in the Lambda: benchmarks/solver/handler.py and the socket."""
    command_bytes: _Count
    """One PnP command on the wire: 200 matches, zlib; measured."""


def load_prices(over: Path | None = None) -> Prices:
    """Return our prices with the values of the file *over* in place of ours.

    Raises:
        ConfigurationError: *over* is not readable, is not a JSON object, or holds a value that is no price.
    """
    values: dict[str, Any] = msgspec.json.decode(_OURS.read_bytes())
    if over is None:
        return msgspec.convert(values, Prices)
    try:
        return msgspec.convert(values | msgspec.json.decode(over.read_bytes(), type=dict[str, Any]), Prices)
    except OSError as error:
        raise ConfigurationError(
            f"cannot read {over}: {error.strerror}", hint="name an existing file with --prices"
        ) from error
    except (msgspec.DecodeError, RecursionError) as error:
        raise ConfigurationError(
            f"{over} holds no prices: {error}",
            hint=f"write a JSON object with some of these names: {', '.join(values)}",
        ) from error

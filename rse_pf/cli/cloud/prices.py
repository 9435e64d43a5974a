"""rse-pf cloud prices: the prices of an estimate, and how to replace them by those of AWS."""

from __future__ import annotations

import argparse
from datetime import date, datetime, timezone
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.files import replace_file
from rse_pf.terminal import counted, show

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --refresh and the file."""
    parser.add_argument(
        "--refresh", action="store_true",
        help="read the prices of cloud.region from AWS, and write them to prices.json in this folder",
    )  # fmt: skip
    parser.add_argument("--prices", type=Path, metavar="FILE", help="show or write this file instead")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Show the prices; return 1 while some are unverified, stale or of another region."""
    from rse_pf.aws.money.prices import PRICES_FILE, load_prices, operators_prices

    file = args.prices or Path(PRICES_FILE)
    if args.refresh:
        _refresh(file, settings)
        args.prices = file
    prices = operators_prices(args.prices, Path.cwd()) if args.prices is None else load_prices(args.prices)
    show(f"prices of {prices.as_of}, {prices.region}, {prices.currency}: {prices.source}")
    for kind, server in sorted(prices.servers.items()):
        show(f"  {kind:<26}{server.per_hour:>12.4f} an hour, {server.spot_per_hour:.4f} as Spot instance")
    for name in prices.__struct_fields__:
        value = getattr(prices, name)
        if isinstance(value, float) and "_per_" in name:
            show(f"  {name:<26}{value:>12.6g}")
    warnings = prices.warnings(today=date.today(), region=settings.cloud.region)
    for line in warnings:
        show(line)
    return 1 if warnings else 0


def _refresh(file: Path, settings: PlatformSettings) -> None:
    from rse_pf.aws.account import open_account
    from rse_pf.aws.money.price_list import PRICE_LIST_REGION, document_of, refresh
    from rse_pf.aws.money.prices import load_prices
    from rse_pf.config.elasticity import instance_types

    kinds, region = instance_types(settings.cloud), settings.cloud.region
    prices = refresh(
        load_prices(file if file.exists() else None), kinds, region=region,
        price_list=open_account(PRICE_LIST_REGION), account=open_account(region),
        now=datetime.now(timezone.utc),
    )  # fmt: skip
    replace_file(file, document_of(prices))
    show(f"wrote {file}: {counted(len(prices.unverified), 'price')} could not be read from AWS")

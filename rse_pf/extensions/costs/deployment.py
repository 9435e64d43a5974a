"""The costs of a deployment by its stage, for the verbs that change it and show its state."""

from __future__ import annotations

from datetime import datetime, timezone

from rse_pf.config import PlatformSettings
from rse_pf.extensions.costs.bill import HOURS, Bill, bill_of, parked
from rse_pf.extensions.costs.prices import Prices

__all__ = ["DeploymentCosts"]


class DeploymentCosts:
    """The costs of a deployment without robots: running, parked, and deeply parked (``deep``)."""

    def __init__(self, settings: PlatformSettings, prices: Prices) -> None:
        self.prices = prices
        self.running = bill_of(settings, prices)
        self.parked, self.deep = (parked(self.running, deep=deep) for deep in (False, True))

    def line(self, bill: Bill) -> str:
        """Return the total of *bill* as words: its price an hour and a month."""
        money = self.prices.currency
        return f"{bill.total / HOURS:.2f} {money} an hour, {bill.total:.0f} {money} a month"

    def warnings(self, settings: PlatformSettings) -> list[str]:
        """Return warnings of prices that are over a year old or of another region; empty if neither."""
        today = datetime.now(timezone.utc).date()
        return self.prices.warnings(today=today, region=settings.cloud.region)

    def line_now(self, settings: PlatformSettings, stage: str, servers: int) -> str:
        """Return the line about the costs of a deployment in *stage* with this number of servers."""
        bills = {"up": self.running, "incomplete": self.running, "parked": self.parked}
        if stage not in bills:
            return "costs nothing but stored data: rse-pf cloud down lists it"
        more = max(0, servers - settings.scaling.min_servers)
        hourly = bills[stage].total / HOURS + more * self.prices.server(settings.cloud.instance_type).per_hour
        return f"costs {hourly:.2f} {self.prices.currency} an hour now, plus robots' requests and stored data"

    def kept_per_month(self, kind: str, gb: float | None) -> float:
        """Return the monthly cost of a ``bucket`` of *gb* GB (None: 0), or of a ``secret``."""
        return (
            self.prices.stored_per_gb_month * (gb or 0.0)
            if kind == "bucket"
            else self.prices.secret_per_month
        )

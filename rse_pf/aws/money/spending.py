"""Read what a deployment has cost so far this month, from Cost Explorer.

AWS charges 0.01 USD for each request, and counts costs about a day late.  Costs are told apart by the tag
that every stack gives its resources; AWS does that only after the tag was activated for costs.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from typing import Any

from rse_pf.aws.account import Account

__all__ = ["REQUEST_USD", "Spending", "read_spending"]

REQUEST_USD = 0.01
"""What AWS charges for each page of an answer."""
_TAG = "rse-pf"
_MAX_PAGES = 5
_METRIC = "UnblendedCost"


@dataclass(frozen=True, slots=True, kw_only=True)
class Spending:
    """Costs from ``begin`` up to now, in ``currency``, by service, the dearest first.

    ``is_ours`` says that they are of the platform's resources alone; otherwise they are of the whole
    account, since no resource has an active tag.  ``account_total`` is of the whole account.
    """

    begin: date
    currency: str
    total: float
    account_total: float
    services: tuple[tuple[str, float], ...]
    is_ours: bool
    requests: int


def read_spending(account: Account, *, now: datetime) -> Spending:
    """Return the costs of the month of *now*, in UTC.

    Raises:
        ConfigurationError: AWS refused; Cost Explorer may be off, or the permission missing.
        StoreError: AWS does not answer.
    """
    begin = now.date().replace(day=1)
    rows, pages = _rows(account, begin, now.date() + timedelta(days=1))
    ours: Counter[str] = Counter()
    everything: Counter[str] = Counter()
    currency = "USD"
    for row in rows:
        tag, service = row["Keys"]
        amount = row["Metrics"][_METRIC]
        currency = str(amount["Unit"])
        everything[service] += float(amount["Amount"])  # type: ignore[assignment]
        if str(tag).partition("$")[2]:
            ours[service] += float(amount["Amount"])  # type: ignore[assignment]
    costs = ours or everything
    services = sorted(costs.items(), key=lambda service: (-service[1], service[0]))
    return Spending(
        begin=begin,
        currency=currency,
        total=sum(costs.values()),
        account_total=sum(everything.values()),
        services=tuple((name, float(amount)) for name, amount in services),
        is_ours=bool(ours),
        requests=pages,
    )


def _rows(account: Account, begin: date, end: date) -> tuple[list[dict[str, Any]], int]:
    """Return the groups of all pages, and how many pages there were; a page more costs a request more."""
    rows: list[dict[str, Any]] = []
    more: dict[str, str] = {}
    for page in range(1, _MAX_PAGES + 1):
        answer = account.find(
            "ce", "get_cost_and_usage",
            TimePeriod={"Start": begin.isoformat(), "End": end.isoformat()}, Granularity="MONTHLY",
            Metrics=[_METRIC],
            GroupBy=[{"Type": "TAG", "Key": _TAG}, {"Type": "DIMENSION", "Key": "SERVICE"}], **more,
        ) or {}  # fmt: skip
        rows += [row for period in answer.get("ResultsByTime", ()) for row in period.get("Groups", ())]
        if not answer.get("NextPageToken"):
            return rows, page
        more = {"NextPageToken": str(answer["NextPageToken"])}
    return rows, _MAX_PAGES

"""Costs of a month: those with the platform's tag, or of the whole account while no tag is active."""

from __future__ import annotations

from datetime import date, datetime, timezone
from typing import Any

from rse_pf.aws.account import Account, open_account
from rse_pf.aws.money.spending import read_spending

NOW = datetime(2026, 11, 23, 1, 0, tzinfo=timezone.utc)


def row(tag: str, service: str, amount: float) -> dict[str, Any]:
    return {
        "Keys": [f"rse-pf${tag}", service],
        "Metrics": {"UnblendedCost": {"Amount": str(amount), "Unit": "USD"}},
    }


class Answering(Account):
    """An account that gives pages of costs, and notes what is asked."""

    def __init__(self, *pages: list[dict[str, Any]]) -> None:
        super().__init__("ap-northeast-2")
        self.left = list(pages)
        self.asked: list[dict[str, Any]] = []

    def find(self, service: str, method: str, **arguments: Any) -> dict[str, Any] | None:
        assert (service, method) == ("ce", "get_cost_and_usage")
        self.asked.append(arguments)
        page = {"ResultsByTime": [{"Groups": self.left.pop(0)}]}
        return {**page, "NextPageToken": "more"} if self.left else page


def test_costs_with_the_tag_are_ours_and_the_dearest_service_comes_first() -> None:
    account = Answering(
        [row("ab12", "S3", 1.0), row("", "EC2", 100.0)], [row("ab12", "EC2", 7.5), row("cd34", "EC2", 2.5)]
    )

    told = read_spending(account, now=NOW)

    assert (told.is_ours, told.total, told.account_total, told.currency) == (True, 11.0, 111.0, "USD")
    assert told.services == (("EC2", 10.0), ("S3", 1.0))
    assert (told.begin, told.requests) == (date(2026, 11, 1), 2)
    assert account.asked[0]["TimePeriod"] == {"Start": "2026-11-01", "End": "2026-11-24"}
    assert account.asked[1]["NextPageToken"] == "more"


def test_without_an_active_tag_the_sum_is_of_the_whole_account_and_says_so() -> None:
    told = read_spending(Answering([row("", "EC2", 100.0)]), now=NOW)

    assert (told.is_ours, told.total) == (False, 100.0)


def test_pages_are_bounded_since_each_one_is_charged_for() -> None:
    account = Answering(*([row("", "EC2", 1.0)] for _ in range(20)))

    assert read_spending(account, now=NOW).requests == 5
    assert len(account.asked) == 5


def test_the_first_day_of_a_month_is_a_period_of_a_day() -> None:
    account = Answering([])

    told = read_spending(account, now=datetime(2027, 1, 1, tzinfo=timezone.utc))

    assert account.asked[0]["TimePeriod"] == {"Start": "2027-01-01", "End": "2027-01-02"}
    assert (told.total, told.services) == (0, ())


def test_the_answer_of_cost_explorer_is_understood(region: str) -> None:
    from moto.ce.models import ce_backends

    queue = ce_backends["123456789012"]["aws"].cost_usage_results_queue
    queue.append({"ResultsByTime": [{"Total": {}, "Estimated": True, "Groups": [row("ab12", "EC2", 7.5)]}]})

    assert read_spending(open_account(region), now=NOW).services == (("EC2", 7.5),)

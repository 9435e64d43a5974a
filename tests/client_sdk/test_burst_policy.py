"""Daily budget and circuit breaker of the burst function, and the addresses that may receive a token."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from client_sdk.offloading.burst_policy import BurstPolicy, burst_address, check_burst_url
from rse_pf.errors import UsageError

DAY_S = 86400.0


def rules(budget: int = 1000) -> BurstPolicy:
    return BurstPolicy(commands_per_day=budget)


def fail(of: BurstPolicy, now: float, times: int = 1, **changes: float) -> None:
    for _ in range(times):
        of.count_sent()
        of.count_failure(now, **changes)


def test_the_budget_of_a_day_is_spent_once_and_is_there_again_on_the_next():
    budget = rules(3)
    for _ in range(3):
        assert budget.may_send(10.0)
        budget.count_sent()
        budget.count_answer(10.0, 0.1)

    assert not budget.may_send(10.0 + DAY_S - 1)
    assert budget.may_send(10.0 + DAY_S)


@given(st.lists(st.tuples(st.floats(0, 3 * DAY_S), st.booleans()), max_size=200), st.integers(0, 20))
def test_no_run_spends_more_than_the_budget_in_its_day(events: list[tuple[float, bool]], budget: int):
    limited, sent = rules(budget), []
    for now, works in sorted(events):
        if limited.may_send(now):
            limited.count_sent()
            sent.append(now)
            if works:
                limited.count_answer(now, 0.1)
            else:
                limited.count_failure(now)

    first = sent[0] if sent else 0.0
    assert sum(now < first + DAY_S for now in sent) <= budget
    assert len(sent) <= 4 * budget


def test_three_failures_in_a_row_open_the_breaker_and_one_trial_closes_it():
    breaker = rules()
    assert breaker.may_send(0.0)
    fail(breaker, 0.0, 2)
    assert breaker.may_send(0.0)
    fail(breaker, 0.0)

    assert not breaker.may_send(0.4)
    assert breaker.may_send(0.75)
    breaker.count_sent()
    assert not breaker.may_send(0.75), "one trial at a time"
    breaker.count_answer(0.8, 0.05)
    assert breaker.may_send(0.8)


@pytest.mark.parametrize(
    ("url", "own", "address"),
    [
        ("/burst", "ws://127.0.0.1:8700/ws", "http://127.0.0.1:8700/burst"),
        ("/burst", "wss://user:secret@robots.example/ws", "https://robots.example/burst"),
        ("https://other.example/burst", "wss://robots.example/ws", "https://other.example/burst"),
        ("http://127.0.0.1:8702/burst", "ws://127.0.0.1:8700/ws", "http://127.0.0.1:8702/burst"),
        ("http://robots.example/burst", "wss://robots.example/ws", None),
        ("//other.example/burst", "ws://robots.example/ws", None),
        ("ftp://robots.example/burst", "ws://robots.example/ws", None),
        ("https://robots.example:x/burst", "ws://robots.example/ws", None),
        ("https://robots.example/a b", "ws://robots.example/ws", None),
        ("https://robots.example/\r\nX: y", "ws://robots.example/ws", None),
    ],
)
def test_a_token_goes_only_where_it_is_as_safe_as_at_the_servers(url: str, own: str, address: str | None):
    assert burst_address(url, own) == address


def test_an_address_that_the_user_cannot_mean_is_refused_at_once():
    with pytest.raises(UsageError) as raised:
        check_burst_url("robots.example/burst", "ws://robots.example/ws")

    assert "https://HOST/burst" in raised.value.hint
    assert check_burst_url("", "ws://robots.example/ws") == ""
    assert check_burst_url(None, "ws://robots.example/ws") is None

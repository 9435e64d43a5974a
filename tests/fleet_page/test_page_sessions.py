"""Keys of the fleet page work once; what they open is bounded and ends."""

from __future__ import annotations

import itertools

import pytest

from rse_pf.errors import Forbidden, Unauthorized
from rse_pf.extensions.fleet_page.page_sessions import KEY_LIFE_S, MAX_SESSIONS, PageSessions


def sessions() -> PageSessions:
    numbers = itertools.count()
    return PageSessions(secret=lambda: f"secret-{next(numbers)}")


def test_a_key_opens_one_session_and_a_stolen_one_opens_none() -> None:
    page = sessions()
    key = page.new_key("view", now_s=0.0)

    session, role = page.open(key, now_s=1.0)

    assert role == "view"
    assert page.role_of(session, now_s=2.0) == "view"
    with pytest.raises(Unauthorized):
        page.open(key, now_s=3.0)


@pytest.mark.parametrize("given", ["", "secret-99", "x" * 10_000, "\ud800"])
def test_an_unknown_key_opens_nothing(given: str) -> None:
    page = sessions()
    page.new_key("view", now_s=0.0)

    with pytest.raises(Unauthorized):
        page.open(given, now_s=1.0)


def test_a_key_is_worth_nothing_after_an_hour() -> None:
    page = sessions()
    key = page.new_key("view", now_s=0.0)

    with pytest.raises(Unauthorized):
        page.open(key, now_s=KEY_LIFE_S + 1.0)


def test_only_an_operators_key_lets_a_session_operate() -> None:
    page = sessions()
    session, _ = page.open(page.new_key("view", now_s=0.0), now_s=0.0)

    with pytest.raises(Forbidden):
        page.check_operator(session, now_s=1.0)
    with pytest.raises(Forbidden):
        page.promote(session, page.new_key("view", now_s=1.0), now_s=1.0)
    with pytest.raises(Unauthorized):
        page.promote(session, "guessed", now_s=1.0)
    key = page.new_key("operate", now_s=1.0)
    page.promote(session, key, now_s=2.0)
    page.check_operator(session, now_s=3.0)
    other, _ = page.open(page.new_key("view", now_s=3.0), now_s=3.0)
    with pytest.raises(Unauthorized):
        page.promote(other, key, now_s=4.0)


def test_sessions_are_bounded_and_the_one_that_was_used_longest_ago_ends() -> None:
    page = sessions()
    opened = [
        page.open(page.new_key("view", now_s=float(at)), now_s=float(at))[0] for at in range(MAX_SESSIONS)
    ]
    page.role_of(opened[0], now_s=100.0)

    page.open(page.new_key("view", now_s=101.0), now_s=101.0)

    assert page.role_of(opened[0], now_s=102.0) == "view"
    with pytest.raises(Unauthorized):
        page.role_of(opened[1], now_s=102.0)


def test_keys_that_nobody_uses_are_bounded_and_the_oldest_is_forgotten() -> None:
    page = sessions()
    keys = [page.new_key("view", now_s=0.0) for _ in range(65)]

    with pytest.raises(Unauthorized):
        page.open(keys[0], now_s=1.0)
    assert page.open(keys[1], now_s=1.0)[1] == "view"


def test_a_session_that_nobody_uses_ends() -> None:
    page = sessions()
    session, _ = page.open(page.new_key("operate", now_s=0.0), now_s=0.0)

    with pytest.raises(Unauthorized):
        page.role_of(session, now_s=13 * 3600.0)

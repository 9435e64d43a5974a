"""When a server counts as healthy."""

from __future__ import annotations

from rse_pf.config import HealthSettings
from rse_pf.scaling.health import Health, observe, time_to_notice_s

SETTINGS = HealthSettings()


def states(checks: str, *, step_s: float = 5.0) -> list[str]:
    """States after each check, one every *step_s*; ``+`` is good, ``-`` failed."""
    health, seen = Health(started_s=0.0), []
    for i, check in enumerate(checks):
        health = observe(health, check == "+", SETTINGS, now_s=(i + 1) * step_s)
        seen.append(health.state)
    return seen


def test_two_good_checks_make_a_server_healthy() -> None:
    assert states("++") == ["starting", "healthy"]


def test_two_failed_checks_in_a_row_make_a_healthy_server_unhealthy() -> None:
    assert states("++-+--") == ["starting", *["healthy"] * 4, "unhealthy"]


def test_a_new_server_is_not_judged_before_the_grace_is_over() -> None:
    assert states("-" * 17)[-1] == "starting"
    assert states("-" * 18)[-1] == "unhealthy"


def test_the_time_to_notice_adds_the_checks_and_the_last_timeout() -> None:
    assert time_to_notice_s(SETTINGS, local=False) == 5 * 2 + 4
    assert time_to_notice_s(SETTINGS, local=True) == 0.25 * 2 + 0.25

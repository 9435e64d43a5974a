"""Admission: values in, a decision out, in the order rate, size, scope, deadline, backlog."""

from __future__ import annotations

import math
from typing import Any

import pytest
from backend.scheduling.admitted import queued

from rse_pf.auth.tokens import Claims
from rse_pf.backend.gateway.admission import Admission, UnreadRefusal
from rse_pf.backend.gateway.rate_limits import CutOff
from rse_pf.config import ServingSettings, SessionSettings

SERVING = ServingSettings(max_queue_per_robot=4, max_unread_bytes=1_000_000)
ADMITTED: dict[str, Any] = {
    "queued": queued("r", within=1.0), "claims": None, "backlog": (0, 0.0, 0.0), "max_delay_s": math.inf,
}  # fmt: skip


def claims(*scopes: str) -> Claims:
    return Claims(robot="r", token_id="t", issued_s=0.0, expires_s=9.0, key_id="k", scopes=scopes)


@pytest.fixture
def admission() -> Admission:
    return Admission(SessionSettings(max_commands_per_s=20.0, command_burst=40), SERVING)


def reason(admission: Admission, **changed: object) -> str:
    refusal = admission.judge(**{**ADMITTED, **changed})
    return "" if refusal is None else refusal.reason


def test_a_command_that_breaks_no_limit_is_admitted(admission: Admission):
    assert reason(admission) == ""
    assert reason(admission, claims=claims("services:*")) == ""
    assert reason(admission, backlog=(3, 0.4, 0.1)) == ""


@pytest.mark.parametrize(
    ("changed", "expected", "code"),
    [
        ({"claims": claims("services:other", "data:read")}, "scope", "forbidden"),
        ({"queued": queued("r", within=0.0)}, "expired", "expired"),
        ({"backlog": (4, 0.0, 0.3)}, "robot-queue", "busy"),
        ({"backlog": (0, 0.6, 0.1)}, "behind", "busy"),
        ({"backlog": (0, 0.5, 0.1), "max_delay_s": 0.025}, "behind", "busy"),
    ],
)
def test_a_command_beyond_a_limit_is_refused_for_its_reason(
    admission: Admission, changed: dict, expected: str, code: str
):
    refusal = admission.judge(**{**ADMITTED, **changed})

    assert refusal is not None
    assert (refusal.reason, refusal.error.code) == (expected, code)
    if code == "busy":
        assert refusal.error.retry_after_ms is not None
        assert 100.0 <= refusal.error.retry_after_ms <= 5000.0


def test_of_several_reasons_the_first_in_order_is_told(admission: Admission):
    everything = {
        "queued": queued("r", within=0.0), "claims": claims("data:read"), "backlog": (9, 9.0, 1.0),
    }  # fmt: skip

    assert reason(admission, **everything) == "scope"
    assert reason(admission, **{**everything, "claims": None}) == "expired"
    assert reason(admission, backlog=(9, 9.0, 1.0)) == "robot-queue"


def test_a_robot_above_its_rate_is_refused_and_then_cut_off(admission: Admission):
    decisions = [admission.judge_rate(("default", "r"), 5.0) for _ in range(200)]

    assert decisions[:40] == [None] * 40
    assert isinstance(decisions[40], UnreadRefusal)
    assert decisions[40].reason == "rate"
    assert decisions[40].retry_after_ms == pytest.approx(50.0)
    assert CutOff() in decisions
    assert admission.judge_rate(("default", "another"), 5.0) is None


def test_a_command_is_refused_before_decoding_if_its_turn_would_come_too_late(admission: Admission):
    assert admission.judge_delay(0.25, 0.1, math.inf) is None
    refusal = admission.judge_delay(0.25, 0.2, 0.025)

    assert refusal is not None
    assert (refusal.reason, refusal.retry_after_ms) == ("unread", pytest.approx(200.0))
    assert admission.judge_delay(5.0, 0.2, 0.025) is None, "it has more time than compute and network need"


def test_the_bytes_that_wait_for_the_decoder_are_bounded_and_suspects_get_a_quarter(admission: Admission):
    assert admission.judge_size(200_000, 0, 1) is None
    assert admission.judge_size(100_000, 200_000, 1) is not None
    assert admission.judge_size(700_000, 200_000, 0) is None
    assert admission.judge_size(200_000, 900_000, 0) is not None
    assert admission.judge_size(2_000_000, 0, 0) is None, "one alone is always taken"

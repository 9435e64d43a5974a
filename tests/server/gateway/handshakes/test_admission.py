"""Admission: values in, a decision out, in the order rate, size, scope, deadline, backlog."""

from __future__ import annotations

from typing import Any

import pytest

from rse_pf.auth.tokens import Claims
from rse_pf.config import SessionSettings
from rse_pf.identity import RobotId
from rse_pf.server.gateway.admission import Admission
from rse_pf.server.scheduling.command_queue import QueueBacklog
from tests.kit.admitted_commands import queued

ADMITTED: dict[str, Any] = {
    "queued": queued("r", within=1.0), "claims": None, "backlog": QueueBacklog(),
}  # fmt: skip


def claims(*scopes: str) -> Claims:
    return Claims(
        robot=RobotId("default", "r"), token_id="t", issued_s=0.0, expires_s=9.0, key_id="k", scopes=scopes
    )


@pytest.fixture
def admission(monkeypatch: pytest.MonkeyPatch) -> Admission:
    monkeypatch.setattr("rse_pf.server.gateway.admission._MAX_UNREAD_BYTES", 1_000_000)
    return Admission(SessionSettings(max_commands_per_s=20.0), max_queue=4)


def reason(admission: Admission, **changed: object) -> str:
    refusal = admission.refusal(**{**ADMITTED, **changed})
    return "" if refusal is None else refusal.reason


@pytest.mark.parametrize(
    ("changed", "expected", "code"),
    [
        ({"claims": claims("services:other", "data:read")}, "scope", "forbidden"),
        ({"queued": queued("r", within=0.0)}, "expired", "expired"),
        ({"backlog": QueueBacklog(4)}, "robot-queue", "busy"),
        ({"backlog": QueueBacklog(0, 0.6)}, "behind", "busy"),
    ],
)
def test_a_command_beyond_a_limit_is_refused_for_its_reason(
    admission: Admission, changed: dict, expected: str, code: str
):
    refusal = admission.refusal(**{**ADMITTED, **changed})

    assert refusal is not None
    assert (refusal.reason, refusal.error.code) == (expected, code)
    if code == "busy":
        assert refusal.error.retry_after_ms is not None
        assert 100.0 <= refusal.error.retry_after_ms <= 5000.0


def test_the_bytes_that_wait_for_the_decoder_are_bounded_and_suspects_get_a_quarter(admission: Admission):
    assert admission.may_wait(200_000, 0, 1)
    assert not admission.may_wait(100_000, 200_000, 1)
    assert admission.may_wait(700_000, 200_000, 0)
    assert not admission.may_wait(200_000, 900_000, 0)
    assert admission.may_wait(2_000_000, 0, 0), "one alone is always taken"

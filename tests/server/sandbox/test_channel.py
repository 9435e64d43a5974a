"""Nothing that a sandbox says is trusted."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rse_pf.errors import BadMessage, BadRequest
from rse_pf.server.sandbox.channel import MAX_COMPUTE_MS, is_ready, outcome_of
from rse_pf.server.sandbox.policy import SandboxReply


@pytest.mark.parametrize("compute_ms", [0, 0.0, 1.5, 7, MAX_COMPUTE_MS])
def test_a_reply_is_its_value_its_time_and_its_state(compute_ms: float) -> None:
    assert outcome_of([True, {"x": 1}, b"state", compute_ms]) == SandboxReply({"x": 1}, compute_ms, b"state")
    assert outcome_of([True, None, None, compute_ms]) == SandboxReply(None, compute_ms, None)


def test_a_failure_is_the_error_of_its_code_with_texts_of_bounded_length() -> None:
    error = outcome_of([False, "bad-request", "x" * 10_000, "y" * 10_000, 1.0])

    assert isinstance(error, BadRequest)
    assert (len(error.message), len(error.hint)) == (500, 500)


@pytest.mark.parametrize("snapshot", [300_000_000, -1, True, 1.5, "text", [1, 2], {"a": 1}, np.zeros(3)])
def test_a_snapshot_that_is_not_bytes_is_refused_and_never_made_into_bytes(snapshot: Any) -> None:
    with pytest.raises(BadMessage):
        outcome_of([True, None, snapshot, 1.0])


@pytest.mark.parametrize("is_good", [True, False])
@pytest.mark.parametrize(
    "compute_ms",
    [math.nan, math.inf, -math.inf, -0.1, -1, 1e300, 2**64 - 1, True, None, "nan", "1", [1], np.zeros(2)],
)
def test_a_time_that_is_no_number_of_milliseconds_is_refused(compute_ms: Any, is_good: bool) -> None:
    with pytest.raises(BadMessage):
        outcome_of([True, 1, None, compute_ms] if is_good else [False, "internal", "", "", compute_ms])


@pytest.mark.parametrize(
    "message",
    [
        None, True, 7, 1.5, "ready", b"ready", {}, {0: True}, [], ["ready"], [True], [True, 1],
        [True, 1, None], [True, 1, None, 1.0, 1], [1, 1, None, 1.0], [0, "internal", "", "", 1.0],
        [False, 7, "", "", 1.0],
        [False, "internal", ["x"], "", 1.0], [False, "internal", "", None, 1.0], [np.zeros(2)], np.zeros(4),
        [np.ones(1), 1, None, 1.0], ["x" * 1000],
    ],
    ids=repr,
)  # fmt: skip
def test_a_message_of_another_form_is_refused(message: Any) -> None:
    with pytest.raises(BadMessage):
        outcome_of(message)


@pytest.mark.parametrize(
    "message",
    [None, "ready", b"ready", [], ["Ready"], ["ready", 1], [b"ready"], [np.zeros(2)], {0: "ready"}],
    ids=repr,
)
def test_only_the_message_of_its_start_says_that_a_sandbox_is_ready(message: Any) -> None:
    assert is_ready(["ready"])
    assert not is_ready(message)

"""Read what a sandbox says, of which nothing is trusted: a hostile service can send any message itself."""

from __future__ import annotations

import math
from typing import TypeGuard

from rse_pf.errors import BadMessage, RsePfError, error_from_code
from rse_pf.server.sandbox.policy import SandboxReply

__all__ = ["MAX_COMPUTE_MS", "is_ready", "outcome_of"]

MAX_COMPUTE_MS = 86_400_000.0
"""No command takes a day."""
_MAX_TEXT = 500


def is_ready(message: object) -> bool:
    """Return whether *message* tells that the sandbox has started."""
    match message:
        case [str(word)]:
            return word == "ready"
    return False


def outcome_of(message: object) -> SandboxReply | RsePfError:
    """Return the outcome of a request in *message*: a reply, or the typed failure of the service.

    Raises:
        BadMessage: It is no message of this kind: its parts have other types, or its time is not a number
            of milliseconds from 0 to `MAX_COMPUTE_MS`.
    """
    match message:
        case [True, value, (None | bytes()) as snapshot, compute_ms] if _is_time(compute_ms):
            return SandboxReply(value, float(compute_ms), snapshot)
        case [False, str(code), str(text), str(hint), compute_ms] if _is_time(compute_ms):
            return error_from_code(code, text[:_MAX_TEXT], hint=hint[:_MAX_TEXT])
    raise BadMessage("it sent a message of no known form")


def _is_time(value: object) -> TypeGuard[float]:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return math.isfinite(value) and 0 <= value <= MAX_COMPUTE_MS

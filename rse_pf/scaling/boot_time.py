"""How long a new server takes on AWS from its launch to readiness: one table, step by step.

The time limits of a launch follow from it: the launch hook waits for `BOOT_LIMIT_S`.  What EC2
takes is an estimate, shared with `rse_pf.scaling.cloud_delays`; the rest was measured in a bare Debian root.
"""

from __future__ import annotations

from rse_pf.scaling.cloud_delays import DESIGNS, Delay

__all__ = ["BOOT_LIMIT_S", "BOOT_S", "STEPS", "ready_within_s", "retry_within_s"]

_MEASURED = "python -m benchmarks cloud.boot, on a loaded machine"

STEPS: tuple[Delay, ...] = (
    *DESIGNS["0.1.0"].launch[:2],
    Delay(step="fetch, verify and unpack the environment", low_s=3.0, high_s=10.0, source=_MEASURED),
    Delay(step="agent and server until /readyz", low_s=3.0, high_s=10.0, source=_MEASURED),
)
"""Pending to running; kernel and cloud-init; the package; the processes."""
BOOT_S = sum(step.high_s for step in STEPS)
"""From the launch to /readyz, in seconds, at the slow end of each step."""

BOOT_LIMIT_S = 4 * round(BOOT_S)
"""Time that the launch hook gives a new server to become ready; then it is replaced."""
_RETRY_SHARE, _READY_SHARE = 0.4, 0.3
"""Of `BOOT_LIMIT_S`; the rest is for the machine's own start and for unpacking the environment."""


def retry_within_s() -> float:
    """Return how long a new machine tries to get its role and its package, of `BOOT_LIMIT_S`."""
    return BOOT_LIMIT_S * _RETRY_SHARE


def ready_within_s() -> float:
    """Return how long the agent of a new machine waits for its server, of `BOOT_LIMIT_S`."""
    return BOOT_LIMIT_S * _READY_SHARE

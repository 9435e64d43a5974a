"""How long a new server takes on AWS from its launch to readiness, and the time limits that follow.

The launch hook waits for `BOOT_LIMIT_S`.  What EC2 takes is an estimate, from experience; the rest was
measured in a bare Debian root on a loaded machine (``python -m benchmarks cloud.boot``).
"""

from __future__ import annotations

__all__ = ["BOOT_LIMIT_S", "BOOT_S", "ready_within_s", "retry_within_s"]

_PENDING_TO_RUNNING_S = 20.0
_KERNEL_AND_CLOUD_INIT_S = 35.0
_ENVIRONMENT_S = 10.0
"""Fetch, verify and unpack it."""
_PROCESSES_S = 10.0
"""Agent and server until /readyz."""
BOOT_S = _PENDING_TO_RUNNING_S + _KERNEL_AND_CLOUD_INIT_S + _ENVIRONMENT_S + _PROCESSES_S
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

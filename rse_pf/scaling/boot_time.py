"""The time of a new server on AWS from its launch to readiness, and the time limits that follow from it.

The launch hook waits for `BOOT_LIMIT_S`.  The times of EC2 are estimates; the others were measured in a bare
Debian root on a loaded machine (``python -m benchmarks cloud.boot``).
"""

from __future__ import annotations

__all__ = ["BOOT_LIMIT_S", "BOOT_S", "ready_within_s", "retry_within_s"]

# Seconds from the launch until EC2 reports the instance as running (estimate).
_PENDING_TO_RUNNING_S = 20.0
# Seconds of kernel and cloud-init (estimate).
_KERNEL_AND_CLOUD_INIT_S = 35.0
# Seconds to fetch, verify and unpack the environment.
_ENVIRONMENT_S = 10.0
# Seconds until agent and server answer /readyz.
_PROCESSES_S = 10.0
# Seconds from the launch to /readyz, at the slow end of each step.
BOOT_S = _PENDING_TO_RUNNING_S + _KERNEL_AND_CLOUD_INIT_S + _ENVIRONMENT_S + _PROCESSES_S
# Seconds that the launch hook gives a new server before it is replaced: four times the usual boot.
BOOT_LIMIT_S = 4 * round(BOOT_S)
# Share of `BOOT_LIMIT_S` in which a machine repeats failed requests for its role and package.
_RETRY_SHARE = 0.4
# Share of `BOOT_LIMIT_S` that the server has to become ready; the rest is for boot and environment.
_READY_SHARE = 0.3


def retry_within_s() -> float:
    """Return for how long a new machine repeats failed requests for its role and package, in seconds."""
    return BOOT_LIMIT_S * _RETRY_SHARE


def ready_within_s() -> float:
    """Return for how long the agent of a new machine waits for its server, in seconds."""
    return BOOT_LIMIT_S * _READY_SHARE

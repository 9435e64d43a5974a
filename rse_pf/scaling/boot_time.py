"""The time of a new server on AWS from its launch until it is ready, and the time limits that depend on it.

The launch hook waits for `BOOT_LIMIT_S`.  The times of EC2 are estimates; the others were measured in a plain
Debian system on a loaded machine (``python -m benchmarks cloud.boot``).
"""

from __future__ import annotations

__all__ = ["BOOT_LIMIT_S", "BOOT_S", "ready_within_s", "retry_within_s"]

# Seconds from the launch of an instance until EC2 reports it as running (estimate).
_PENDING_TO_RUNNING_S = 20.0
# Seconds that the kernel and cloud-init take to start (estimate).
_KERNEL_AND_CLOUD_INIT_S = 35.0
# Seconds to fetch, verify and unpack the Python environment of the server.
_ENVIRONMENT_S = 10.0
# Seconds from the start of the agent and the server until /readyz answers.
_PROCESSES_S = 10.0
# Seconds from the launch of a machine until /readyz answers: the sum of the steps above.
BOOT_S = _PENDING_TO_RUNNING_S + _KERNEL_AND_CLOUD_INIT_S + _ENVIRONMENT_S + _PROCESSES_S
# Seconds after which the launch hook replaces a server that is not ready: four times the usual boot.
BOOT_LIMIT_S = 4 * round(BOOT_S)
# Fraction of `BOOT_LIMIT_S` in which a machine repeats failed requests for its role and package.
_RETRY_FRACTION = 0.4
# Fraction of `BOOT_LIMIT_S` in which the server must become ready; the rest is for boot and environment.
_READY_FRACTION = 0.3


def retry_within_s() -> float:
    """Return the seconds for which a new machine repeats failed requests for its credentials and package."""
    return BOOT_LIMIT_S * _RETRY_FRACTION


def ready_within_s() -> float:
    """Return the seconds for which the agent of a new machine waits until its server is ready."""
    return BOOT_LIMIT_S * _READY_FRACTION

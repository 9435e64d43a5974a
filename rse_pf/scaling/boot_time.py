"""How long a new server takes on AWS from its launch to readiness: one table, step by step.

The time limits of a launch follow from it: ``cloud.boot_s`` is four times `BOOT_S` by default.  What EC2
takes is an estimate, shared with `rse_pf.scaling.cloud_delays`; the rest was measured in a bare Debian root.
"""

from __future__ import annotations

from rse_pf.scaling.cloud_delays import DESIGNS, Delay

__all__ = ["BOOT_S", "STEPS"]

_MEASURED = "python -m benchmarks.cloud.boot, on a loaded machine"

STEPS: tuple[Delay, ...] = (
    *DESIGNS["0.1.0"].launch[:2],
    Delay(step="fetch, verify and unpack the environment", low_s=3.0, high_s=10.0, source=_MEASURED),
    Delay(step="agent and server until /readyz", low_s=3.0, high_s=10.0, source=_MEASURED),
)
"""Pending to running; kernel and cloud-init; the package; the processes."""
BOOT_S = sum(step.high_s for step in STEPS)
"""From the launch to /readyz, in seconds, without luck."""

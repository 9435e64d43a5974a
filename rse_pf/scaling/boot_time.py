"""How long a new server takes on AWS from its launch to readiness: one table, step by step.

Two steps are measured in a bare Debian root, the others are what is known of EC2 and marked so; the sum is an
estimate until a deployment has been measured.  Every time limit of a boot is derived from it.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["BOOT_S", "STEPS", "BootStep"]


@dataclass(frozen=True, slots=True)
class BootStep:
    """One step: its length in seconds, and where the number comes from."""

    name: str
    seconds: float
    source: str


STEPS = (
    BootStep("EC2 from pending to running", 20.0, "knowledge of EC2: 10 to 20 s"),
    BootStep("kernel, network and cloud-init", 35.0, "knowledge of Debian's cloud image: 25 to 35 s"),
    BootStep("fetch, verify and unpack the environment", 10.0, "benchmarks.cloud.boot, rounded up"),
    BootStep("agent and server until /readyz", 10.0, "benchmarks.cloud.boot, rounded up"),
)
BOOT_S = sum(step.seconds for step in STEPS)
"""From the launch to /readyz, in seconds."""

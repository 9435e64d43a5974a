"""The period of a sample, and the number of samples in a row that each rule needs, in both profiles.

The paper's profile uses ``scaling.period_s`` and `BUSY_PERIODS`; the fast profile grows after three samples
of 10 s.  The time for which a fleet must be idle before it shrinks is the same in both profiles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rse_pf.config import ScalingSettings
from rse_pf.config.elasticity import FAST_PERIOD_S, FAST_SAMPLES

__all__ = ["REPEAT_S", "Cadence", "cadence_of"]

# Seconds after which a rule that still holds acts again: CloudWatch repeats the scaling action of an alarm
# once a minute, whatever the alarm's period is (AWS, "Using Amazon CloudWatch alarms").
REPEAT_S = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Cadence:
    """The period of a sample, and the number of samples in a row after which a rule acts.

    Attributes:
        period_s: Length of a sample in seconds.
        busy: Number of busy or crowded samples before the platform grows.
        idle: Number of samples without any request before it shrinks.
        underused: Number of samples with little work before it shrinks; 0: it never shrinks for this reason.
        repeat: Number of samples between two actions of a rule that goes on holding.
        is_fast: Whether the profile is ``fast``, in which the servers publish their CPU themselves.
    """

    period_s: int
    busy: int
    idle: int
    underused: int
    repeat: int
    is_fast: bool

    @property
    def most(self) -> int:
        """Return the largest number of samples in a row that any rule needs."""
        return max(self.busy, self.idle, self.underused)


# Number of busy samples in a row before the platform grows in the paper's profile: a load of one period ends
# before a new server has started.
BUSY_PERIODS = 2


def cadence_of(settings: ScalingSettings) -> Cadence:
    """Return the cadence of the profile that ``scaling.profile`` names."""
    is_fast = settings.profile == "fast"
    period_s = FAST_PERIOD_S if is_fast else settings.period_s
    return Cadence(
        period_s=period_s,
        busy=FAST_SAMPLES if is_fast else BUSY_PERIODS,
        idle=settings.idle_s // period_s,
        underused=math.ceil(settings.underused_s / period_s),
        repeat=max(1, REPEAT_S // period_s),
        is_fast=is_fast,
    )

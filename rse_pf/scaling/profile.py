"""The period of a sample and the number of samples of each rule, in both profiles.

The paper's profile takes ``scaling.period_s`` and `BUSY_PERIODS`; the fast one takes three samples
of 10 s.  How long a fleet must be idle is the same in both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rse_pf.config import ScalingSettings
from rse_pf.config.elasticity import FAST_PERIOD_S, FAST_SAMPLES

__all__ = ["REPEAT_S", "Cadence", "cadence_of"]

# Seconds after which a rule that still holds acts again: an alarm repeats a scaling action once a minute,
# whatever its period is (AWS, "Using Amazon CloudWatch alarms").
REPEAT_S = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Cadence:
    """The period of a sample, in seconds, and numbers of samples in a row.

    Attributes:
        period_s: One sample.
        busy: Before the platform grows.
        idle: Without any work, before it shrinks.
        underused: With little work, before it shrinks; 0 is never.
        repeat: Between two actions of a rule that holds all the time.
        is_fast: Whether the servers publish these samples themselves.
    """

    period_s: int
    busy: int
    idle: int
    underused: int
    repeat: int
    is_fast: bool

    @property
    def most(self) -> int:
        """Return the largest number of samples that a rule needs."""
        return max(self.busy, self.idle, self.underused)


# Busy samples in a row before the paper's profile grows: a load of one minute ends before a server starts.
BUSY_PERIODS = 2


def cadence_of(settings: ScalingSettings) -> Cadence:
    """Return the cadence of ``scaling.profile``."""
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

"""How long each step from load to a serving server takes on AWS, as an estimate with its source.

Nothing here was measured on AWS.  The local platform plays these delays, so that its policy, its health
checks and its robots run as there: `rse-pf experiment elasticity --as-cloud`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["DESIGNS", "NO_DELAYS", "CloudDelays", "Delay", "Design"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Delay:
    """One step, from *low_s* to *high_s* seconds."""

    step: str
    low_s: float
    high_s: float
    source: str

    @property
    def middle_s(self) -> float:
        """Return the time that is played."""
        return (self.low_s + self.high_s) / 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudDelays:
    """What the local platform adds: seconds until metrics are seen, and until a new server runs."""

    metrics_s: float = 0.0
    launch_s: float = 0.0


NO_DELAYS = CloudDelays()
"""A platform on this machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """One design of the cloud.

    Attributes:
        profile: ``scaling.profile``.
        warm_up_s: ``scaling.warm_up_s``.
        rebalances: Whether robots of crowded servers are asked to move.
        metrics: From the end of a period until its alarm is evaluated.
        launch: From the decision until the load balancer sends robots.
    """

    profile: str
    warm_up_s: int
    rebalances: bool
    metrics: Delay
    launch: tuple[Delay, ...]

    @property
    def delays(self) -> CloudDelays:
        """Return the sums that are played."""
        return CloudDelays(
            metrics_s=self.metrics.middle_s, launch_s=sum(phase.middle_s for phase in self.launch)
        )


_EC2 = "estimate, from experience with EC2; not measured by us"
_BOOT = "estimate: our boot root on a loaded machine, not an instance"
_CHECKS = "two checks of the load balancer, one each 5 s, and the start of the server"

DESIGNS: Mapping[str, Design] = {
    "0.1.0": Design(
        profile="paper", warm_up_s=60, rebalances=False,
        metrics=Delay(
            step="metrics of EC2, each minute, until the alarm sees them", low_s=30.0, high_s=60.0,
            source=_EC2,
        ),
        launch=(
            Delay(step="instance from pending to running", low_s=10.0, high_s=20.0, source=_EC2),
            Delay(step="kernel and cloud-init", low_s=25.0, high_s=35.0, source=_EC2),
            Delay(step="fetch 50 MB, install with pip", low_s=15.0, high_s=25.0, source=_BOOT),
            Delay(step="agent, server, health checks", low_s=15.0, high_s=15.0, source=_CHECKS),
        ),
    ),
    "now": Design(
        profile="fast", warm_up_s=60, rebalances=True,
        metrics=Delay(
            step="our own metrics, each 10 s, until the alarm sees them", low_s=2.0, high_s=6.0,
            source="a second for the agents, the rest for CloudWatch; estimate",
        ),
        launch=(
            Delay(step="stopped instance of the warm pool to running", low_s=8.0, high_s=15.0, source=_EC2),
            Delay(step="kernel; cloud-init has run before", low_s=10.0, high_s=15.0, source=_EC2),
            Delay(step="environment is on the disk", low_s=0.0, high_s=0.0, source="the warm pool's boot"),
            Delay(step="agent, server, health checks", low_s=12.0, high_s=12.0, source=_CHECKS),
        ),
    ),
}  # fmt: skip
"""The design of version 0.1.0, and this one with the fast profile and a warm pool."""

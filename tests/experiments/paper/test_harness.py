"""What an experiment records besides its commands: the policy, and the figures of the load generator."""

from __future__ import annotations

from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.paper.harness import policy_parameters


def test_compression_shortens_periods_but_no_threshold():
    full, fast = policy_parameters(PlatformSettings(), 1.0), policy_parameters(PlatformSettings(), 30.0)

    assert (fast["period_s"], fast["idle_s"]) == (full["period_s"] / 30, full["idle_s"] / 30)
    assert {name: fast[name] for name in fast if name not in ("period_s", "idle_s")} == {
        name: full[name] for name in full if name not in ("period_s", "idle_s")
    }

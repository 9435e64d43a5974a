"""Sentences that announce what the scale modifier will do next, and when.

The sentences follow the rules of `rse_pf.scaling.policy.decide`; a test compares the sentences with its
decisions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rse_pf.config import ScalingSettings
from rse_pf.config.elasticity import IDLE_CPU_PERCENT, UNDERUSED_CPU_PERCENT
from rse_pf.scaling.profile import cadence_of
from rse_pf.scaling.rules import BIG_STEP, STEP

__all__ = ["waiting_for"]

# Words for the numbers 0 to 10.
_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def waiting_for(policy: Mapping[str, Any], settings: ScalingSettings, *, servers: int) -> list[str]:
    """Return sentences about the conditions for which the scale modifier waits, the most important first.

    Args:
        policy: The scale modifier's part of the platform's status: ``elastic``, ``samples`` of complete
            periods, and the smallest and largest number of servers.
        settings: The group scaling of the platform's settings.
        servers: Number of servers that are starting or serving.
    """
    if not policy.get("elastic"):
        return ["the scale modifier is off: no server is added, removed or replaced by itself"]
    reasons = (
        ["servers end too soon after their start: the next start waits"] if policy.get("crash_loop") else []
    )
    samples = list(policy.get("samples", ()))
    if not samples:
        period_s = cadence_of(settings).period_s / float(policy.get("compress", 1.0))
        return [*reasons, f"no whole period of {period_s:g} s was measured yet"]
    busy = _busy_reason(samples, policy, settings, servers)
    idle = _idle(samples, policy, settings, servers)
    if busy or idle:
        return [*reasons, busy or idle]
    return [
        *reasons,
        _underused_reason(samples, policy, settings, servers) or "the servers are neither busy nor idle",
    ]


def _busy_reason(
    samples: Sequence[Mapping[str, Any]], policy: Mapping[str, Any], settings: ScalingSettings, servers: int
) -> str:
    limit, needed = settings.busy_cpu_percent, cadence_of(settings).busy
    count = _count_last_that(samples, lambda sample: float(sample["cpu_percent"]) >= limit)
    if not count:
        return ""
    newest = float(samples[-1]["cpu_percent"])
    step = BIG_STEP if newest >= settings.very_busy_cpu_percent else STEP
    most = int(policy.get("max_servers", settings.max_servers))
    measured = f"{min(count, needed)} of {needed} samples above {limit:g} %"
    if servers >= most:
        return f"{measured}, but {servers} servers are the most that are allowed"
    more = _servers(min(step, most - servers), more=True)
    if count >= needed:
        return f"{measured}: {more} when the servers that start have warmed up"
    return f"{measured}: {more} after {_count_phrase(needed - count, 'further such sample')}"


def _idle(
    samples: Sequence[Mapping[str, Any]], policy: Mapping[str, Any], settings: ScalingSettings, servers: int
) -> str:
    limit = IDLE_CPU_PERCENT
    count = _count_last_that(
        samples, lambda sample: float(sample["requests"]) == 0 and float(sample["cpu_percent"]) < limit
    )
    return _shrink_reason(count, cadence_of(settings).idle, "idle", policy, settings, servers)


def _underused_reason(
    samples: Sequence[Mapping[str, Any]], policy: Mapping[str, Any], settings: ScalingSettings, servers: int
) -> str:
    needed, limit = cadence_of(settings).underused, UNDERUSED_CPU_PERCENT
    count = _count_last_that(samples, lambda sample: float(sample["cpu_percent"]) < limit)
    enough = needed and servers > int(policy.get("min_servers", settings.min_servers))
    return (
        _shrink_reason(count, needed, f"below {limit:g} % CPU", policy, settings, servers) if enough else ""
    )


def _shrink_reason(
    count: int, needed: int, load: str, policy: Mapping[str, Any], settings: ScalingSettings, servers: int
) -> str:
    if not count:
        return ""
    measured = f"{min(count, needed)} of {needed} samples {load}"
    least = int(policy.get("min_servers", settings.min_servers))
    if servers <= least:
        verb = "is" if least == 1 else "are"
        return f"{measured}: nothing happens, {_servers(least)} {verb} the fewest that are allowed"
    if count >= needed:
        return f"{measured}: one server leaves now"
    kind = "idle" if load == "idle" else "such"
    return f"{measured}: one server leaves after {_count_phrase(needed - count, f'further {kind} sample')}"


def _count_last_that(samples: Sequence[Mapping[str, Any]], holds: Any) -> int:
    count = 0
    for sample in reversed(samples):
        if not holds(sample):
            break
        count += 1
    return count


def _servers(count: int, *, more: bool = False) -> str:
    word = _NUMBERS[count] if 0 <= count < len(_NUMBERS) else str(count)
    plural = "" if count == 1 else "s"
    if more:
        return f"{word} more server{plural} start{'s' if count == 1 else ''}"
    return f"{word} server{plural}"


def _count_phrase(count: int, noun: str) -> str:
    word = _NUMBERS[count] if 0 <= count < len(_NUMBERS) else str(count)
    return f"{word} {noun}{'' if count == 1 else 's'}"

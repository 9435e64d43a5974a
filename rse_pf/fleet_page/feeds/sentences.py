"""What the scale modifier waits for and what an event means, in words; pure.

The sentences follow `rse_pf.scaling.policy.decide`, whose result they announce: a test compares the two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rse_pf.config import ScalingSettings
from rse_pf.config.elasticity import IDLE_CPU_PERCENT, UNDERUSED_CPU_PERCENT
from rse_pf.scaling.policy import BIG_STEP, STEP
from rse_pf.scaling.profile import cadence_of

__all__ = ["event_sentence", "waiting_for"]

_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def waiting_for(policy: Mapping[str, Any], settings: ScalingSettings, *, servers: int) -> list[str]:
    """Return what the scale modifier waits for, the most important first.

    Args:
        policy: Its part of the platform's status: ``elastic``, ``samples`` of whole periods, bounds.
        settings: Group scaling of the platform.
        servers: Those that start or serve.
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


def event_sentence(event: Mapping[str, Any]) -> str:
    """Return *event* as a sentence; its kind and details if it has none of its own."""
    kind = str(event.get("event", ""))
    text = _EVENTS.get(kind)
    values = {name: _format_value(value) for name, value in event.items()}
    if text is not None:
        return text.format_map(_Missing(values))
    details = [
        f"{name} {value}"
        for name, value in values.items()
        if value and name not in ("event", "time_s", "number")
    ]
    return f"{kind.replace('-', ' ')}: {', '.join(details)}" if details else kind.replace("-", " ")


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


def _format_value(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


class _Missing(dict[str, str]):
    def __missing__(self, key: str) -> str:
        return "-"


_EVENTS = {
    "adopted": "servers of an earlier control plane were adopted: {servers}",
    "balancer-back": "the load balancer is back after {seconds} s",
    "balancer-failed": "the load balancer does not start: {reason}",
    "balancer-gone": "the load balancer ended: {reason}",
    "balancer-killed": "the load balancer was killed",
    "certificate-renewed": "the certificate was renewed",
    "crash-loop": "servers end too soon after their start: the next one starts in {wait_s} s",
    "data-server-down": "data server {name} ended ({code})",
    "data-server-failed": "data server {name} does not start: {error}",
    "data-server-silent": "data server {name} does not answer and is killed",
    "data-server-start": "data server {name} starts",
    "data-server-up": "data server {name} is ready",
    "drain-over": "{server} has left after {seconds} s",
    "drain-start": "{server} drains ({reason}); its robots move",
    "grow": "{servers} more: {reason}",
    "control-plane-silent": "the control plane does not answer",
    "metrics-port-taken": "port {port} is taken: the metrics have another one",
    "not-written": "something could not be written: {reason}",
    "over": "the control plane has ended",
    "platform-gone": "the platform has ended",
    "platform-ready": "the platform is ready after {seconds} s",
    "rebalance": "{robots} robots of {server} are asked to move",
    "replace": "{server} is replaced by {by}: {reason}",
    "robot-moved": "{robot} moved from {before} to {server}",
    "roll-step": "{server} is replaced, one of {of}",
    "roll-stopped": "{server} did not become healthy, so the old servers stay",
    "server-failed": "{server} did not start: {reason}",
    "server-gone": "{server} ended (exit code {exit_code})",
    "server-healthy": "{server} is healthy and takes robots",
    "server-killed": "{server} was killed by the operator",
    "server-launched": "{server} starts",
    "server-out": "{server} gets no robots any more",
    "server-paused": "{server} was paused by the operator",
    "server-ready": "{server} is ready",
    "server-resumed": "{server} goes on",
    "server-unhealthy": "{server} is unhealthy: {reason}",
    "shrink": "{servers} less: {reason}",
    "standby-started": "a warm standby was started",
}

"""The scale modifier box on one machine: carry out what the scaling policy decides.

The policy says that servers must be replaced; three rules here decide when: 1.  A server whose process has
exited is replaced at once.  2.  Replacements of servers that exited soon after their start are limited in
number per minute (a crash loop).  3.  Servers that run but fail their checks are never replaced all at once:
if all fail, the fault is more likely
   in the monitor or the machine.

Time is an argument, and the effects are those of the `Fleet`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

from rse_pf.config import ScalingSettings
from rse_pf.local.control.fleet import Fleet, ServerHealth
from rse_pf.scaling.policy import Action, FleetState, decide, find_rule_starts
from rse_pf.scaling.rules import Sample

__all__ = ["LocalScaleModifier", "bounds_for", "may_start_s", "replace_now"]

_MINUTE_S = 60.0


def bounds_for(scaling: ScalingSettings, count: int) -> ScalingSettings:
    """Return *scaling* with ``min_servers`` lowered, or ``max_servers`` raised, to *count* if needed."""
    return dataclasses.replace(
        scaling, min_servers=min(scaling.min_servers, count), max_servers=max(scaling.max_servers, count)
    )


def may_start_s(starts: Sequence[float], *, now_s: float, per_minute: int) -> float:
    """Return when a server that exited soon after its start may be replaced; *now_s* means at once.

    Args:
        starts: Times at which replacements were started, oldest first, in seconds.
        now_s: The present time on the same clock.
        per_minute: Most replacements in any 60 s.
    """
    within = [start for start in starts if now_s - start < _MINUTE_S]
    return now_s if len(within) < per_minute else within[-per_minute] + _MINUTE_S


def replace_now(broken: Sequence[str], *, healthy: int, replacing: int) -> tuple[str, ...]:
    """Return which of the *broken* servers, which run but fail their checks, are replaced now.

    With the *replacing* ones, whose replacements are still starting, they are at most half as many as the
    *healthy* servers, but one is always allowed.  The others wait, and may recover meanwhile.
    """
    return tuple(broken[: max(max(1, healthy // 2) - replacing, 0)])


class LocalScaleModifier:
    """Applies the scaling policy to the servers of a `Fleet`.

    It keeps the times of its actions and replacements, and since when each rule of the policy holds.
    """

    def __init__(
        self,
        servers: Fleet,
        settings: ScalingSettings,
        *,
        max_restarts_per_minute: int,
        compress: float = 1.0,
        minimum: Callable[[], int] | None = None,
        emit: Callable[..., None],
    ) -> None:
        """Describe a scale modifier of *servers*.

        Args:
            servers: The fleet that is changed.
            settings: Bounds and rules of the scaling policy.
            max_restarts_per_minute: Limit of rule 2 of this module.
            compress: Factor by which the policy's times are shortened, for experiments.
            minimum: Returns the scheduled ``min_servers`` of now; None uses that of *settings*.
            emit: Called with the name of an event and its details as keywords.
        """
        self._servers = servers
        self._settings = settings
        self._minimum = minimum
        self._since_s: dict[str, float] = {}
        self._restarts_per_minute = max_restarts_per_minute
        self._compress = compress
        self._emit = emit
        self._acted_s = -math.inf
        self._starts: list[float] = []
        self._in_crash_loop = False
        self._last: Action | None = None

    def act(
        self, samples: Sequence[Sample], *, now_s: float, period_over: bool, hold: bool = False
    ) -> tuple[Action, ...]:
        """Decide, carry the actions out, and return what the policy decided.

        If any action needs a new server and the disk is full, nothing is done, and the result is empty.

        Args:
            samples: One sample for each of the last whole periods, oldest first.
            now_s: The present time on the clock of the samples.
            period_over: Whether a period has just ended; in between, the number of servers changes only if
                servers are missing.
            hold: Only replace servers, because an operation of the operator changes their number.
        """
        self._starts = [start for start in self._starts if now_s - start < _MINUTE_S]
        self._in_crash_loop = self._in_crash_loop and bool(self._starts)
        standing = self._servers.standing(now_s)
        fleet = FleetState(
            servers=standing.servers,
            warming=standing.warming,
            unhealthy=(*standing.dead, *standing.broken),
            acted_s=self._acted_s if period_over else now_s,
        )
        if self._minimum is not None:
            self._settings = dataclasses.replace(self._settings, min_servers=self._minimum())
        if period_over:
            self._since_s = find_rule_starts(
                samples, self._settings, now_s=now_s, compress=self._compress, before=self._since_s
            )
        actions = decide(
            samples,
            fleet,
            self._settings,
            now_s=now_s,
            compress=self._compress,
            since_s=self._since_s,
        )
        if period_over:
            self._acted_s = now_s
        if any(action.kind != "shrink" for action in actions) and self._servers.is_full():
            return ()  # a new server could not start, and an unhealthy one may recover meanwhile
        for action in actions:
            if action.kind == "replace":
                self._replace(standing, now_s)
            elif not hold:
                self._scale(action)
        return actions

    def document(self) -> dict[str, Any]:
        """Return bounds, crash loop and last action of the policy as plain JSON values."""
        last = None
        if self._last is not None:
            last = {"kind": self._last.kind, "servers": self._last.servers, "reason": self._last.reason}
        return {
            "min_servers": self._settings.min_servers,
            "max_servers": self._settings.max_servers,
            "compress": self._compress,
            "crash_loop": self._in_crash_loop,
            "last_action": last,
        }

    def _scale(self, action: Action) -> None:
        if action.kind == "grow":
            names = self._servers.grow(action.servers)
            self._emit("grow", servers=len(names), names=list(names), reason=action.reason)
            self._last = action
        elif action.kind == "shrink":
            name = self._servers.shrink(action.reason)
            if name is not None:
                self._emit("shrink", servers=1, names=[name], reason=action.reason)
                self._last = action

    def _replace(self, standing: ServerHealth, now_s: float) -> None:
        """Replace the servers that have exited or are unhealthy, as far as the rules of this module allow."""
        for name, ended_early in standing.dead.items():
            at_s = may_start_s(self._starts, now_s=now_s, per_minute=self._restarts_per_minute)
            if ended_early and at_s > now_s:
                self._report_crash_loop(name, at_s - now_s)
            else:
                self._launch_replacement(name, "it ended", now_s)
        for name in replace_now(standing.broken, healthy=standing.healthy, replacing=standing.replacing):
            self._launch_replacement(name, "it failed its health checks", now_s)

    def _launch_replacement(self, name: str, reason: str, now_s: float) -> None:
        self._starts.append(now_s)
        new = self._servers.launch_replacement(name)
        self._emit("replace", servers=1, server=name, by=new, names=[name], reason=reason)
        self._last = Action(kind="replace", servers=1, names=(name,), reason=reason)

    def _report_crash_loop(self, name: str, wait_s: float) -> None:
        """Emit ``crash-loop`` if this is the first server that has to wait in this crash loop."""
        if not self._in_crash_loop:
            self._emit("crash-loop", server=name, wait_s=round(wait_s, 3), reason="servers end too soon")
        self._in_crash_loop = True

"""Decide which commands and services are not tried again: the poison and the crash-loop rules.

A request that killed two environments is poison; a service that killed five of them in half a minute rests
for a while.  Promises no clock: time comes in; and bounded memory whatever robots send.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import Literal

from rse_pf.config import ServiceSettings

__all__ = ["CircuitBreaker", "Verdict"]

Verdict = Literal["run", "poison", "quarantined"]

_MAX_DIGESTS = 10_000


class CircuitBreaker:
    """What one worker knows of deadly requests and services."""

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings
        self._deaths_of_request: OrderedDict[str, int] = OrderedDict()
        self._deaths_of_service: dict[str, deque[float]] = {}
        self._until: dict[str, float] = {}

    def verdict(self, service: str, digest: str, now: float) -> Verdict:
        """Say whether a request with this digest may run now."""
        if self._deaths_of_request.get(digest, 0) >= self._settings.poison_crashes:
            return "poison"
        return "quarantined" if self.rests_s(service, now) > 0 else "run"

    def died(self, service: str, digest: str, now: float) -> None:
        """Note that an environment died while it worked on this request."""
        self._deaths_of_request[digest] = self._deaths_of_request.pop(digest, 0) + 1
        if len(self._deaths_of_request) > _MAX_DIGESTS:
            self._deaths_of_request.popitem(last=False)
        deaths = self._deaths_of_service.setdefault(service, deque(maxlen=self._settings.breaker_crashes))
        deaths.append(now)
        full = len(deaths) == self._settings.breaker_crashes
        if full and now - deaths[0] <= self._settings.breaker_window_s:
            self._until[service] = now + self._settings.breaker_open_s
            deaths.clear()

    def rests_s(self, service: str, now: float) -> float:
        """Return for how long *service* still rests, in seconds; 0 if it may run."""
        return max(0.0, self._until.get(service, now) - now)

    def resting(self, now: float) -> list[str]:
        """Return the services that rest, sorted."""
        return sorted(service for service in self._until if self.rests_s(service, now) > 0)

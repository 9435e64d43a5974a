"""Decide which requests and services are not run again after crashes.

A request that crashed ``poison_crashes`` sandboxes is poison.  A service that crashed ``breaker_crashes`` of
them within `WINDOW_S` is refused for ``breaker_open_s``: its circuit breaker is open.  Time is an
argument, and memory is bounded whatever robots send.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import Literal

from rse_pf.config import ServiceSettings

__all__ = ["CircuitBreaker"]

_MAX_DIGESTS = 10_000
WINDOW_S = 30.0
"""``services.breaker_crashes`` within this open the circuit breaker."""


class CircuitBreaker:
    """What one worker knows of crashing requests and services."""

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings
        self._crashes_of_request: OrderedDict[str, int] = OrderedDict()
        self._crashes_of_service: dict[str, deque[float]] = {}
        self._open_until: dict[str, float] = {}

    def verdict(self, service: str, digest: str, now: float) -> Literal["run", "poison", "open"]:
        """Return whether a request with this digest may run now, and if not, why."""
        if self._crashes_of_request.get(digest, 0) >= self._settings.poison_crashes:
            return "poison"
        return "open" if self.open_for_s(service, now) > 0 else "run"

    def crashed(self, service: str, digest: str, now: float) -> None:
        """Note that a sandbox crashed while it worked on this request."""
        self._crashes_of_request[digest] = self._crashes_of_request.pop(digest, 0) + 1
        if len(self._crashes_of_request) > _MAX_DIGESTS:
            self._crashes_of_request.popitem(last=False)
        crashes = self._crashes_of_service.setdefault(service, deque(maxlen=self._settings.breaker_crashes))
        crashes.append(now)
        full = len(crashes) == self._settings.breaker_crashes
        if full and now - crashes[0] <= WINDOW_S:
            self._open_until[service] = now + self._settings.breaker_open_s
            crashes.clear()

    def open_for_s(self, service: str, now: float) -> float:
        """Return for how many more seconds *service* is refused; 0 if it may run."""
        return max(0.0, self._open_until.get(service, now) - now)

    def open_services(self, now: float) -> list[str]:
        """Return the services that are refused now, sorted."""
        return sorted(service for service in self._open_until if self.open_for_s(service, now) > 0)

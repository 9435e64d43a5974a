"""Decide which requests and services are not run again after crashes.

A request that crashed ``poison_crashes`` sandboxes is poison.  A service that crashed ``breaker_crashes`` of
them within `WINDOW_S` is refused for ``breaker_open_s``: its circuit breaker is open.  Time is an
argument, and memory is bounded whatever robots send.
"""

from __future__ import annotations

from collections import OrderedDict, deque

from rse_pf.config import ServiceSettings
from rse_pf.errors import Poison, WorkerLost

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

    def refusal(self, service: str, digest: str, now: float) -> Poison | WorkerLost | None:
        """Return why a request with this digest may not run now, None if it may."""
        if self._crashes_of_request.get(digest, 0) >= self._settings.poison_crashes:
            return Poison(
                "this request crashed every sandbox that ran it and is not tried again",
                hint="send another one; the server's log has the crash",
            )
        open_s = self._open_until.get(service, now) - now
        if open_s <= 0:
            return None
        return WorkerLost(
            f"service {service!r} crashed repeatedly and is refused for another {open_s:.0f} s",
            hint="tell the operator; the server's log has the crashes",
            retry_after_ms=open_s * 1e3,
        )

    def crashed(self, service: str, digest: str, now: float) -> None:
        """Note that a sandbox crashed while it worked on this request."""
        self._crashes_of_request[digest] = self._crashes_of_request.pop(digest, 0) + 1
        if len(self._crashes_of_request) > _MAX_DIGESTS:
            self._crashes_of_request.popitem(last=False)
        crashes = self._crashes_of_service.setdefault(service, deque(maxlen=self._settings.breaker_crashes))
        crashes.append(now)
        if len(crashes) == self._settings.breaker_crashes and now - crashes[0] <= WINDOW_S:
            self._open_until[service] = now + self._settings.breaker_open_s
            crashes.clear()

    def open_services(self, now: float) -> list[str]:
        """Return the services that are refused now, sorted."""
        return sorted(service for service, until_s in self._open_until.items() if until_s > now)

"""Requests that crash sandboxes and services that crash repeatedly are not run again."""

from __future__ import annotations

from rse_pf.backend.sandbox.circuit_breaker import CircuitBreaker
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, WorkerLost

SETTINGS = PlatformSettings.from_dict(
    {"services": {"poison_crashes": 2, "breaker_crashes": 3, "breaker_open_s": 60}}
).services


def code(refusal: RsePfError | None) -> str:
    """Return the error code of a refusal, "" for none."""
    return "" if refusal is None else refusal.code


def test_a_request_that_crashed_twice_is_poison_however_late_it_returns():
    breaker = CircuitBreaker(SETTINGS)
    breaker.crashed("icp", "a", 0.0)
    assert breaker.refusal("icp", "a", 0.0) is None
    breaker.crashed("icp", "a", 1000.0)

    assert code(breaker.refusal("icp", "a", 5000.0)) == "poison"
    assert breaker.refusal("icp", "b", 5000.0) is None


def test_three_crashes_in_half_a_minute_open_the_breaker_of_a_service_for_a_minute():
    breaker = CircuitBreaker(SETTINGS)
    for now, digest in ((0.0, "a"), (20.0, "b"), (30.0, "c")):
        assert breaker.refusal("icp", digest, now) is None
        breaker.crashed("icp", digest, now)

    assert code(breaker.refusal("icp", "d", 30.1)) == "worker-lost"
    assert breaker.refusal("other", "d", 30.1) is None
    assert breaker.open_services(89.9) == ["icp"]
    refusal = breaker.refusal("icp", "d", 80.0)
    assert isinstance(refusal, WorkerLost)
    assert refusal.retry_after_ms == 10_000.0
    assert breaker.refusal("icp", "d", 90.0) is None
    assert breaker.open_services(90.0) == []


def test_crashes_further_apart_do_not_open_the_breaker():
    breaker = CircuitBreaker(SETTINGS)
    for i in range(20):
        breaker.crashed("icp", str(i), i * 15.1)

    assert breaker.refusal("icp", "x", 20 * 15.1) is None


def test_after_it_closed_the_breaker_needs_as_many_crashes_again():
    breaker = CircuitBreaker(SETTINGS)
    for i in range(3):
        breaker.crashed("icp", str(i), float(i))
    breaker.crashed("icp", "late", 70.0)

    assert breaker.refusal("icp", "x", 71.0) is None


def test_memory_is_bounded_however_many_requests_crash():
    breaker = CircuitBreaker(SETTINGS)
    for i in range(12_000):
        breaker.crashed("icp", str(i), i * 100.0)
    for _ in range(2):
        breaker.crashed("icp", "new", 1e7)

    assert code(breaker.refusal("icp", "new", 2e7)) == "poison"
    breaker.crashed("icp", "0", 1e7)
    assert breaker.refusal("icp", "0", 2e7) is None, "its first crash is forgotten by now"

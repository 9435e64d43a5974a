"""A server of a fixed size uses its size of CPU, and no more."""

from __future__ import annotations

import pytest

from rse_pf.backend.scheduling.cpu_throttle import MIN_WAIT_S, CpuThrottle


def test_size_zero_is_no_gate():
    assert CpuThrottle(0.0, 0.02, now=0.0, cpu_s=0.0).wait_s(1.0, 100.0) == 0.0


def test_a_burst_passes_and_a_debt_waits():
    gate = CpuThrottle(0.5, 0.02, now=0.0, cpu_s=0.0)

    assert gate.wait_s(0.0, 0.02) == 0.0
    assert gate.wait_s(0.0, 0.03) == pytest.approx(0.01 / 0.5)
    assert gate.wait_s(0.02, 0.03) == 0.0


def test_rest_earns_no_more_than_the_burst():
    gate = CpuThrottle(0.5, 0.02, now=0.0, cpu_s=0.0)

    assert gate.wait_s(1000.0, 0.0) == 0.0
    assert gate.wait_s(1000.0, 0.03) == pytest.approx(0.02)


def test_waits_are_never_so_short_that_waiting_is_the_work():
    gate = CpuThrottle(1.0, 0.001, now=0.0, cpu_s=0.0)

    assert gate.wait_s(0.0, 0.0010001) == MIN_WAIT_S


@pytest.mark.parametrize("size", [0.1, 0.25, 1.0])
def test_work_without_end_uses_exactly_the_size(size):
    gate = CpuThrottle(size, 0.02, now=0.0, cpu_s=0.0)
    now = cpu_s = 0.0

    while now < 20.0:
        wait_s = gate.wait_s(now, cpu_s)
        if wait_s:
            now += wait_s
        else:
            now, cpu_s = now + 0.005, cpu_s + 0.005

    assert cpu_s / now == pytest.approx(size, rel=0.02)

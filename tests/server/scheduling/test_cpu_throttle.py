"""An emulated server uses as much CPU as its cores have, and no more."""

from __future__ import annotations

import pytest

from rse_pf.server.scheduling.cpu_throttle import CpuThrottle


class Process:
    """A process whose clocks a test moves, and its throttle."""

    def __init__(self, cores: float, burst_s: float = 0.02) -> None:
        self.now = self.cpu_s = 0.0
        self._throttle = CpuThrottle(cores, now=0.0, cpu=lambda: self.cpu_s, burst_s=burst_s)

    def wait_s(self, now: float, cpu_s: float) -> float:
        self.now, self.cpu_s = now, cpu_s
        return self._throttle.wait_s(now)


def test_a_burst_passes_and_a_debt_waits():
    process = Process(0.5)

    assert process.wait_s(0.0, 0.02) == 0.0
    assert process.wait_s(0.0, 0.03) == pytest.approx(0.01 / 0.5)
    assert process.wait_s(0.02, 0.03) == 0.0


@pytest.mark.parametrize("cores", [0.1, 0.25, 1.0])
def test_work_without_end_uses_exactly_the_emulated_cores(cores):
    process = Process(cores)
    now = cpu_s = 0.0

    while now < 20.0:
        wait_s = process.wait_s(now, cpu_s)
        if wait_s:
            now += wait_s
        else:
            now, cpu_s = now + 0.005, cpu_s + 0.005

    assert cpu_s / now == pytest.approx(cores, rel=0.02)

"""The program of the warm standby."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.local.servers.warm_standby import WarmStandby

pytestmark = pytest.mark.system

SOON_S = 30.0


@pytest.fixture
def real(tmp_path: Path) -> Iterator[WarmStandby]:
    made = WarmStandby(tmp_path, dies_with_parent=True)
    yield made
    made.close()


def test_a_standby_reports_when_it_is_warm_and_becomes_a_server_with_its_arguments(
    real: WarmStandby, tmp_path: Path
) -> None:
    real.warm()
    until = time.monotonic() + SOON_S
    while not real.is_warm:
        assert time.monotonic() < until
        assert real.pid is not None, (tmp_path / "standby.log").read_text()

    process = real.take(["serve", "--keys", str(tmp_path / "none.json")], tmp_path / "server-3.log")

    assert process is not None
    assert process.wait(SOON_S) == 2
    assert "cannot read the keys" in (tmp_path / "server-3.log").read_text()


def test_a_standby_imports_at_low_priority_and_serves_at_full_priority(
    real: WarmStandby, tmp_path: Path
) -> None:
    real.warm()
    ours = os.getpriority(os.PRIO_PROCESS, 0)
    until = time.monotonic() + SOON_S
    lowest = ours
    while not real.is_warm:
        assert time.monotonic() < until
        threads = os.listdir(f"/proc/{real.pid}/task")
        lowest = max(lowest, *(priority_of(int(thread)) for thread in threads))

    assert lowest > ours
    assert real.pid is not None
    assert priority_of(real.pid) == ours


def priority_of(thread: int) -> int:
    """Return the niceness of a thread, the least of all if it has ended."""
    try:
        return os.getpriority(os.PRIO_PROCESS, thread)
    except ProcessLookupError:
        return -20

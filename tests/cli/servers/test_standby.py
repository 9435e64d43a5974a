"""The program of the warm standby."""

from __future__ import annotations

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

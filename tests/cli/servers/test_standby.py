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
WITNESS = """
import os, pathlib, sys, threading

class Witness:
    def find_spec(self, name, path=None, target=None):
        if name == "rse_pf.cli.servers.serve":
            niceness = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
            pathlib.Path(__file__).with_name("niceness").write_text(str(niceness))

sys.meta_path.insert(0, Witness())
"""
"""Python runs it at its start: it writes down the niceness of the thread that imports the server."""


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
    real: WarmStandby, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text(WITNESS, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    ours = os.getpriority(os.PRIO_PROCESS, 0)

    real.warm()
    until = time.monotonic() + SOON_S
    while not real.is_warm:
        assert time.monotonic() < until

    assert int((tmp_path / "niceness").read_text(encoding="utf-8")) > ours
    assert real.pid is not None
    assert os.getpriority(os.PRIO_PROCESS, real.pid) == ours

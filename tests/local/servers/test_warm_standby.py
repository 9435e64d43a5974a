"""One process is warm and becomes the next server."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.local.processes import is_alive, mark_of
from rse_pf.local.servers.warm_standby import WarmStandby

pytestmark = pytest.mark.system

SOON_S = 10.0
BECOMES = (
    "import json, os, sys; line = sys.stdin.readline()\n"
    "order = json.loads(line) if line else sys.exit(7)\n"
    "open(order['log'], 'w').write(' '.join(order['arguments']) + ' ' + str(os.getpid()))"
)


@pytest.fixture
def standby(tmp_path: Path) -> Iterator[WarmStandby]:
    made = WarmStandby(tmp_path, dies_with_parent=True, program=(sys.executable, "-c", BECOMES))
    yield made
    made.close()


def test_a_standby_that_died_is_not_taken(tmp_path: Path) -> None:
    standby = WarmStandby(tmp_path, dies_with_parent=True, program=(sys.executable, "-c", "pass"))
    assert standby.take(["serve"], tmp_path / "log") is None
    standby.warm()
    handle = os.pidfd_open(standby._process.pid)  # type: ignore[union-attr]
    select.select([handle], [], [], SOON_S)
    os.close(handle)

    assert standby.pid is None
    assert standby.take(["serve"], tmp_path / "log") is None
    standby.close()


def test_a_standby_ends_with_its_platform_and_when_its_input_ends(tmp_path: Path) -> None:
    standby = WarmStandby(tmp_path, dies_with_parent=False, program=(sys.executable, "-c", BECOMES))
    standby.warm()
    process = standby._process
    assert process is not None
    assert process.stdin is not None
    process.stdin.close()  # what a killed control plane leaves behind
    assert process.wait(SOON_S) == 7

    standby.warm()
    assert standby.pid is not None
    mark = mark_of(standby.pid)
    standby.close()
    assert mark is not None
    assert not is_alive(mark)

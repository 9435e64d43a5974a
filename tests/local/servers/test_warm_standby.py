"""One process waits, warm, to become the next server."""

from __future__ import annotations

import os
import select
import sys
import time
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
def spare(tmp_path: Path) -> Iterator[WarmStandby]:
    made = WarmStandby(tmp_path, dies_with_parent=True, program=(sys.executable, "-c", BECOMES))
    yield made
    made.close()


def test_the_one_that_waits_becomes_the_server_that_it_is_told_to_be(
    spare: WarmStandby, tmp_path: Path
) -> None:
    spare.warm()
    waiting = spare.pid

    process = spare.take(["serve", "--server-id", "server-3"], tmp_path / "server-3.log")

    assert process is not None
    assert process.wait(SOON_S) == 0
    assert (tmp_path / "server-3.log").read_text() == f"serve --server-id server-3 {waiting}"
    assert spare.pid is None


def test_only_one_waits_and_it_is_taken_once(spare: WarmStandby, tmp_path: Path) -> None:
    spare.warm()
    first = spare.pid
    spare.warm()

    assert spare.pid == first
    taken = spare.take(["serve"], tmp_path / "log")
    assert taken is not None
    assert spare.take(["serve"], tmp_path / "log") is None
    taken.wait(SOON_S)


def test_a_launch_goes_on_without_a_spare_that_died(tmp_path: Path) -> None:
    spare = WarmStandby(tmp_path, dies_with_parent=True, program=(sys.executable, "-c", "pass"))
    assert spare.take(["serve"], tmp_path / "log") is None
    spare.warm()
    handle = os.pidfd_open(spare._process.pid)  # type: ignore[union-attr]
    select.select([handle], [], [], SOON_S)
    os.close(handle)

    assert spare.pid is None
    assert spare.take(["serve"], tmp_path / "log") is None
    spare.close()


def test_the_real_one_says_that_it_is_warm_and_is_a_server_once_told(tmp_path: Path) -> None:
    real = WarmStandby(tmp_path, dies_with_parent=True)
    real.warm()
    until = time.monotonic() + SOON_S
    while not real.is_warm:
        assert time.monotonic() < until
        assert real.pid is not None, (tmp_path / "spare.log").read_text()

    process = real.take(["serve", "--keys", str(tmp_path / "none.json")], tmp_path / "server-3.log")

    assert process is not None
    assert process.wait(SOON_S) == 2
    assert "cannot read the keys" in (tmp_path / "server-3.log").read_text()


def test_it_goes_with_its_platform_and_when_nobody_can_tell_it_any_more(tmp_path: Path) -> None:
    spare = WarmStandby(tmp_path, dies_with_parent=False, program=(sys.executable, "-c", BECOMES))
    spare.warm()
    process = spare._process
    assert process is not None
    assert process.stdin is not None
    process.stdin.close()  # what a killed control plane leaves behind
    assert process.wait(SOON_S) == 7

    spare.warm()
    assert spare.pid is not None
    mark = mark_of(spare.pid)
    spare.close()
    assert mark is not None
    assert not is_alive(mark)

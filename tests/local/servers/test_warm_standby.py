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


def test_the_standby_becomes_the_server_of_its_arguments(standby: WarmStandby, tmp_path: Path) -> None:
    standby.warm()
    waiting = standby.pid

    process = standby.take(["serve", "--server-id", "server-3"], tmp_path / "server-3.log")

    assert process is not None
    assert process.wait(SOON_S) == 0
    assert (tmp_path / "server-3.log").read_text() == f"serve --server-id server-3 {waiting}"
    assert standby.pid is None


def test_there_is_one_standby_and_it_is_taken_once(standby: WarmStandby, tmp_path: Path) -> None:
    standby.warm()
    first = standby.pid
    standby.warm()

    assert standby.pid == first
    taken = standby.take(["serve"], tmp_path / "log")
    assert taken is not None
    assert standby.take(["serve"], tmp_path / "log") is None
    taken.wait(SOON_S)


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

"""The zygote's process: what it reports of a sandbox, and which one it ends itself."""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Iterator
from typing import Any

import pytest

from rse_pf.processes.fork_server import read_packet, send_order, start_fork_server
from rse_pf.processes.start import ChildPlan

pytestmark = pytest.mark.system
WAIT_S = 20.0
MIB = 1 << 20
CONFIG = {
    "services": [], "memory_bytes": 512 * MIB, "total_bytes": 512 * MIB, "scratch_bytes": MIB,
    "max_bytes": MIB, "temporary": tempfile.gettempdir(),
}  # fmt: skip


class Zygote:
    """A zygote whose worker is this test."""

    def __init__(self, **config: int) -> None:
        plan = ChildPlan(target="rse_pf.server.sandbox.zygote:run", name="zygote")
        self._process = start_fork_server(plan, {**CONFIG, **config})
        self._channel = self._process.connection
        self._channel.settimeout(WAIT_S)

    def report(self) -> tuple[dict[str, Any], list[int]]:
        """Return the next report and the descriptors that came with it."""
        return read_packet(self._channel)

    def create(self, number: int) -> socket.socket:
        """Order sandbox *number* and return the worker's end of its channel."""
        ours, theirs = socket.socketpair()
        with theirs, open(os.devnull, "w") as output:
            send_order(self._process, "create", number, theirs.fileno(), output.fileno())
        return ours

    def close(self) -> None:
        """Let the zygote end by itself, as it does when its worker is gone."""
        self._process.end(WAIT_S)


@pytest.fixture
def started(request: pytest.FixtureRequest) -> Iterator[Zygote]:
    """Yield a zygote that is ready; a parameter changes its limits."""
    zygote = Zygote(**getattr(request, "param", {}))
    assert zygote.report()[0]["event"] == "ready"
    yield zygote
    zygote.close()


@pytest.mark.parametrize("started", [{"total_bytes": MIB}], indirect=True)
def test_a_sandbox_whose_memory_is_above_the_limit_in_all_is_ended_with_the_reason(started: Zygote) -> None:
    with started.create(5):
        _, (handle,) = started.report()
        gone, _ = started.report()

    assert gone["id"] == 5
    assert "memory" in gone["how"]
    assert str(MIB) in gone["how"]
    os.close(handle)

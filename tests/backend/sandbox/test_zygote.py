"""The zygote's process: what it reports of a sandbox, and which one it ends itself."""

from __future__ import annotations

import json
import os
import select
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from typing import Any

import pytest

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
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._channel.settimeout(WAIT_S)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rse_pf.backend.sandbox.zygote", str(theirs.fileno())],
                pass_fds=(theirs.fileno(),),
            )
        self._channel.send(json.dumps({**CONFIG, **config, "worker": os.getpid()}).encode())

    def report(self) -> tuple[dict[str, Any], list[int]]:
        """Return the next report and the descriptors that came with it."""
        data, handles, _, _ = socket.recv_fds(self._channel, 1 << 16, 4)
        return json.loads(data), handles

    def create(self, number: int) -> socket.socket:
        """Order sandbox *number* and return the worker's end of its channel."""
        ours, theirs = socket.socketpair()
        with theirs, open(os.devnull, "w") as output:
            order = json.dumps({"do": "create", "id": number}).encode()
            socket.send_fds(self._channel, [order], [theirs.fileno(), output.fileno()])
        return ours

    def close(self) -> None:
        """Let the zygote end by itself, as it does when its worker is gone."""
        self._channel.close()
        try:
            self._process.wait(WAIT_S)
        finally:
            self._process.kill()


@pytest.fixture
def started(request: pytest.FixtureRequest) -> Iterator[Zygote]:
    """Yield a zygote that is ready; a parameter changes its limits."""
    zygote = Zygote(**getattr(request, "param", {}))
    assert zygote.report()[0]["event"] == "ready"
    yield zygote
    zygote.close()


def test_a_sandbox_is_reported_with_a_descriptor_that_shows_its_end(started: Zygote) -> None:
    channel = started.create(5)
    report, (handle,) = started.report()

    channel.close()

    assert report == {"event": "created", "id": 5}
    assert select.select([handle], [], [], WAIT_S)[0] == [handle]
    gone, _ = started.report()
    assert gone["event"] == "gone"
    assert gone["id"] == 5
    os.close(handle)


@pytest.mark.parametrize("started", [{"total_bytes": MIB}], indirect=True)
def test_a_sandbox_whose_memory_is_above_the_limit_in_all_is_ended_with_the_reason(started: Zygote) -> None:
    with started.create(5):
        _, (handle,) = started.report()
        gone, _ = started.report()

    assert gone["id"] == 5
    assert "memory" in gone["how"]
    assert str(MIB) in gone["how"]
    os.close(handle)

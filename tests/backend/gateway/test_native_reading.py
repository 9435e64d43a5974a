"""A worker reads `pnp` commands with the native codec in its event loop."""

from __future__ import annotations

from typing import Any

import pytest
from backend.gateway.worker_parts import worker_parts

from rse_pf.config import PlatformSettings
from rse_pf.pnp.problems import make_problem
from rse_pf.service import Registry
from rse_pf.services import pnp
from rse_pf.wire import CODECS, Command, Result
from rse_pf.wire.native_codec import NativeReader, native_codec
from rse_pf.wire.plain_pnp import PlainPnp

pytestmark = pytest.mark.skipif(native_codec() is None, reason="the native core is not built: make -C native")


def register(registry: Registry) -> None:
    pnp.register(registry, PlatformSettings().pnp)


@pytest.mark.parametrize("codec", CODECS)
def test_a_worker_reads_a_pnp_command_natively(codec: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Any] = []
    original = NativeReader.read

    def noting(reader: NativeReader, data: bytes) -> Any:
        read.append(original(reader, data))
        return read[-1]

    monkeypatch.setattr(NativeReader, "read", noting)
    problem = make_problem(seed=1, n=200)
    request = pnp.make_request(problem.points_world, problem.pixels, problem.camera, binary=codec == "bin")
    with worker_parts(codec=codec, register=register) as worker:
        connection, wire = worker.join()

        worker.say(connection, Command(id=5, service="pnp", payload=request, stream="camera"))

        assert isinstance(read[-1], Command)
        assert isinstance(read[-1].payload, PlainPnp)
        answer = wire.sent[-1]
        assert isinstance(answer, Result), answer
        assert answer.id == 5

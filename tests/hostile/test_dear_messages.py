"""Messages within every size limit, built to cost as much as they can (T8)."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import cast

import numpy as np
import pytest

from fuzz.meter import MAX_MIB, MAX_MS, Meter
from fuzz.samples import EXPENSIVE, MAX_INPUT_BYTES
from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.errors import ProtocolError
from rse_pf.limits import budget
from rse_pf.pnp.problems import KINECT, make_problem
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import make_request
from rse_pf.services.pnp_reader import pnp_reader
from rse_pf.wire import CODECS, Command, make_codec
from rse_pf.wire.server_codec import make_server_codec

_SLOW_MACHINE = 6.0


@pytest.mark.parametrize("name", EXPENSIVE)
def test_the_most_expensive_known_messages_are_cheap(name: str) -> None:
    speaks, data = EXPENSIVE[name]
    assert len(data) <= MAX_INPUT_BYTES
    meter = Meter()

    for _ in range(2):
        meter.call(make_server_codec(speaks).decode_from_robot, data, ProtocolError)

    print(name, meter.line())
    assert meter.worst_ms < _SLOW_MACHINE * MAX_MS, meter.line()
    assert meter.worst_mib < MAX_MIB, meter.line()


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize(("matches", "spare"), [(341, 2.0), (2000, 2.0), (5000, 1.0)])
def test_messages_of_the_sdk_are_far_below_the_limits(
    name: str, matches: int, spare: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("MESSAGE_VALUES", "MESSAGE_CONTAINERS", "MESSAGE_MEMORY_BYTES"):
        monkeypatch.setattr(budget, limit, int(getattr(budget, limit) / spare))
    problem = make_problem(seed=matches, n=matches)
    command = Command(
        id=1, service="pnp", payload=make_request(problem.points_world, problem.pixels, KINECT), trace="é"
    )
    data = make_codec(name).encode(command)
    if len(data) > SessionSettings().max_message_bytes:
        assert (name, matches) == ("json", 5000), "the wire is too short for it, whatever it holds"
        return

    assert isinstance(make_server_codec(name).decode_from_robot(data), Command)


@pytest.mark.parametrize("inside", [b"[", b'{"type":"command","id":1,"service":"pnp","payload":"'])
def test_refusing_a_bomb_costs_less_than_three_poses(inside: bytes) -> None:
    registry = builtin_services(PlatformSettings())
    codec = make_server_codec("zlib", read_first=pnp_reader(registry, "zlib"))
    problem = make_problem(seed=1, n=200)
    request = make_request(problem.points_world, problem.pixels, KINECT)
    pose = codec.encode(Command(id=1, service="pnp", payload=request))
    bomb = zlib.compress(inside + b"x" * 10**7, 9)

    def answer(data: bytes) -> None:
        dispatch(registry, cast(Command, codec.decode_from_robot(data)), lambda: 0.0)

    # A server inflates at most 262,145 bytes of a bomb (0.09 ms), and solves a pose in 0.04 ms: 2.2 poses.
    # In turns: a pause of the machine meets both.
    costs = [[cpu_s(answer, data) for data in (bomb, pose)] for _ in range(20)]

    of_bomb, of_pose = np.min(costs, axis=0)
    assert of_bomb < 3 * of_pose, costs


def cpu_s(call: Callable[[bytes], None], data: bytes) -> float:
    begin = time.thread_time()
    with suppress(ProtocolError):
        call(data)
    return time.thread_time() - begin

"""The limits of one message, at a real server with its default settings: allowed, and one too much."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

from rse_pf.pnp.problems import KINECT, make_problem
from rse_pf.services.pnp import PnpRequest, make_request
from rse_pf.wire import Command, Failure, Result, make_codec

pytestmark = pytest.mark.system

MESSAGE_BYTES = 256 * 1024
INFLATED_BYTES = 1024 * 1024
DEPTH = 16
CORRESPONDENCES = 5000
CLOSED_AS_TOO_BIG = "closed with 1009"  # RFC 6455, section 7.4.1


def command(payload: str) -> bytes:
    """Return a command in JSON for the service ``echo``."""
    return f'{{"type":"command","id":1,"service":"echo","payload":{payload}}}'.encode()


def spaced(size: int) -> bytes:
    """Return a command of *size* bytes, filled up with white space that zlib makes five times smaller."""
    words = command('{"value":1}')
    blanks = np.random.default_rng(1).choice(list(b" \t\n"), size - len(words)).astype(np.uint8)
    return words[:-1] + blanks.tobytes() + words[-1:]


def nested(depth: int) -> bytes:
    """Return a command of *depth* levels: the command and its payload are two of them."""
    lists = depth - 2
    return command('{"value":' + "[" * lists + "]" * lists + "}")


def pose_of(count: int) -> bytes:
    """Return a binary command for the pose of *count* correspondences."""
    problem = make_problem(seed=1, n=count)
    request = make_request(problem.points_world, problem.pixels, problem.camera, binary=True)
    return make_codec("bin").encode(Command(id=1, service="pnp", payload=request))


def coordinate(number: str) -> bytes:
    """Return a command for a pose; *number* is the first coordinate of a world point."""
    request = PnpRequest(camera=KINECT, points_world=np.ones(12), pixels=np.ones(8))
    codec = make_codec("json")
    whole = codec.encode(Command(id=1, service="pnp", payload=request))
    return whole.replace(b'"points_world":[1.0', b'"points_world":[' + number.encode(), 1)


MESSAGES: dict[str, tuple[str, bytes, str]] = {
    "256 KiB": ("json", spaced(MESSAGE_BYTES), "ok"),
    "256 KiB and a byte": ("json", spaced(MESSAGE_BYTES + 1), CLOSED_AS_TOO_BIG),
    "1 MiB inflated": ("zlib", zlib.compress(spaced(INFLATED_BYTES)), "ok"),
    "1 MiB and a byte inflated": ("zlib", zlib.compress(spaced(INFLATED_BYTES + 1)), "too-large"),
    "16 levels": ("json", nested(DEPTH), "ok"),
    "17 levels": ("json", nested(DEPTH + 1), "too-large"),
    "5000 correspondences": ("bin", pose_of(CORRESPONDENCES), "ok"),
    "5001 correspondences": ("bin", pose_of(CORRESPONDENCES + 1), "too-large"),
    "a number": ("json", coordinate("2.0"), "degenerate"),
    "not a number": ("json", coordinate("NaN"), "bad-message"),
    "infinite": ("json", coordinate("Infinity"), "bad-message"),
    "beyond double precision": ("json", coordinate("1e999"), "bad-message"),
}
"""Of each message its codec, its bytes, and what a robot that sends it gets."""


async def outcome(server: Any, codec: str, data: bytes) -> str:
    """Send *data* as one message; return ``ok``, the code of a failure, or how the connection was closed."""
    async with server.robot(codec) as robot:
        await robot.socket.send(data.decode() if codec == "json" else data)
        try:
            answer = await robot.receive()
        except ConnectionClosed:
            return f"closed with {robot.socket.close_code}"
        assert isinstance(answer, (Result, Failure))
        assert answer.id == 1
        return answer.code if isinstance(answer, Failure) else "ok"


async def test_a_message_is_answered_at_each_limit_and_refused_above_it(start_server, tmp_path):
    builtin = "from rse_pf.services.builtin import builtin_services as make\n"
    (tmp_path / "served_in_tests.py").write_text(builtin)
    server = start_server()

    assert {name: await outcome(server, codec, data) for name, (codec, data, _) in MESSAGES.items()} == {
        name: expected for name, (_, _, expected) in MESSAGES.items()
    }

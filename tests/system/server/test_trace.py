"""One trace id: from the robot to the server's log, to the job's log and to the function's answer and log."""

from __future__ import annotations

import base64
import time
from pathlib import Path
from typing import Any

import pytest

import client_sdk
from client_sdk.tracing import current_trace, traced
from lambda_pnp.answering import Answering
from lambda_pnp.keys import KeyCache
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.pnp.problems import make_problem
from rse_pf.services import pnp
from rse_pf.wire import SUBPROTOCOLS, Command, make_codec

_SERVICES = '''
from pathlib import Path
from typing import Any
import msgspec
from rse_pf.service import Registry, Report
from rse_pf.services import pnp

class Work(msgspec.Struct, frozen=True, kw_only=True):
    name: str = "job"

def make(settings):
    registry = Registry()
    pnp.register(registry, settings.pnp)

    @registry.service("long", kind="long")
    def long(request: Work, *, report: Report) -> Work:
        """Return at once."""
        return request

    return registry
'''


def of_function(trace: str) -> dict[str, Any]:
    """Send a command with *trace* to the function; return the fields of its log line."""
    settings, key = PlatformSettings(), SigningKey.from_seed(b"k" * 32, "key-1")
    problem, lines = make_problem(seed=1), []  # type: ignore[var-annotated]
    request = pnp.make_request(problem.points_world, problem.pixels, problem.camera)
    body = make_codec("zlib").encode(Command(id=7, service="pnp", payload=request, trace=trace))
    answering = Answering(
        settings, KeyCache(lambda: key.key_set().to_json(), 60.0),
        log=lambda **fields: lines.append(fields),
    )  # fmt: skip
    token = key.issue("robot-1", now=time.time(), token_id="t", settings=settings.auth)
    event = {
        "headers": {
            "authorization": f"Bearer {token}", "content-type": f"application/{SUBPROTOCOLS['zlib']}",
        },
        "body": base64.b64encode(body).decode(), "isBase64Encoded": True,
    }  # fmt: skip
    answered = answering.answer(event, now_s=time.time(), left_ms=9e3, clock=time.monotonic)
    assert make_codec("zlib").decode_from_server(answered.body).id == 7
    (line,) = lines
    return line


@pytest.mark.system
async def test_one_id_goes_from_the_robot_to_every_log(start_server: Any, tmp_path: Path) -> None:
    (tmp_path / "served_in_tests.py").write_text(_SERVICES)
    server = start_server(
        keys=True, data={"store": f"dir:{tmp_path / 'store'}"}, serving={"log_level": "debug"}
    )  # fmt: skip

    problem = make_problem(seed=1)
    async with client_sdk.connect(server.url, token=server.token()) as robot:
        with traced() as trace:
            await robot.solve_pnp(problem.points_world, problem.pixels, problem.camera)
            await robot.call("long", {}, on_progress=lambda done, what: None)
            function = of_function(current_trace())

    server.wait_for_log("job")
    logged = [line for line in server.lines if line["event"] in ("command", "job")]
    assert {line["trace"] for line in logged} == {trace} == {function["trace"]}
    assert {(line["event"], line["service"]) for line in logged} == {
        ("command", "pnp"), ("command", "long"), ("job", "long"),
    }  # fmt: skip
    assert (function["service"], function["code"]) == ("pnp", "ok")

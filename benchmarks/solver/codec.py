"""Measure the codecs, and the handler against the bare solver.

    python -m benchmarks solver.codec [--n 500]

For each codec and 200 and 300 matches: bytes, encode and decode (to float64 arrays), thread-CPU
microseconds.  Then one request, bytes in to bytes out (decode, dispatch, encode), over one
`solve_pnp` on ready arrays, interleaved.  Defends: JSON+zlib <= 2.2 x, binary <= 1.3 x of the native solver,
which takes a tenth of the time that PoseLib takes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from rse_pf.config import PlatformSettings
from rse_pf.pnp import solve_pnp
from rse_pf.pnp.problems import PnpProblem, make_problem
from rse_pf.service import Registry, dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpReply, PnpRequest, make_request, wire_types
from rse_pf.wire import CODECS, Command, Result, as_type, make_codec

__all__ = ["measure"]

MATCHES = (200, 300)
PROBLEMS = 32


@benchmark(
    Bar("handler.*.ratio_of.zlib", at_most=2.2),
    Bar("handler.*.ratio_of.json", at_most=2.2),
    Bar("handler.*.ratio_of.bin", at_most=1.3),
)
def run_benchmark(*, n: Annotated[int, "samples of each figure"] = 500) -> dict[str, Any]:
    """Measure the codecs and the handler."""
    return measure(n)


def measure(n: int) -> dict[str, Any]:
    """Return all figures of *n* samples each."""
    registry = builtin_services(PlatformSettings())
    codecs, handler = [], []
    for matches in MATCHES:
        problems = [make_problem(seed=seed, n=matches) for seed in range(PROBLEMS)]
        codecs += [_codec_row(name, problems, registry, n) for name in CODECS]
        handler += _handler_rows(problems, registry, n)
    return {"unit": "thread-CPU us", "codecs": codecs, "handler": handler}


def _codec_row(name: str, problems: list[PnpProblem], registry: Registry, n: int) -> dict[str, Any]:
    codec = make_codec(name, pnp=wire_types(registry))
    commands = [_command(problem, name) for problem in problems]
    sent = [codec.encode(command) for command in commands]
    results = [dispatch(registry, codec.decode_from_robot(data), time.monotonic) for data in sent]  # type: ignore[arg-type]
    answered = [codec.encode(result) for result in results]
    stages: dict[str, Callable[[int], Any]] = {
        "robot encodes": lambda i: codec.encode(commands[i]),
        "server decodes": lambda i: as_type(codec.decode_from_robot(sent[i]).payload, PnpRequest),  # type: ignore[union-attr]
        "server encodes": lambda i: codec.encode(results[i]),
        "robot decodes": lambda i: as_type(codec.decode_from_server(answered[i]).reply, PnpReply),  # type: ignore[union-attr]
    }
    times = _time_interleaved(list(stages.values()), n)
    return {
        "codec": name,
        "matches": len(problems[0].pixels),
        "command_bytes": round(float(np.median([len(data) for data in sent]))),
        "result_bytes": round(float(np.median([len(data) for data in answered]))),
        **{stage: spread(times_us) for stage, times_us in zip(stages, times, strict=True)},
    }


def _handler_rows(problems: list[PnpProblem], registry: Registry, n: int) -> list[dict[str, Any]]:
    def handler(name: str) -> Callable[[int], Any]:
        codec = make_codec(name, pnp=wire_types(registry))
        sent = [codec.encode(_command(problem, name)) for problem in problems]

        def handle(i: int) -> bytes:
            command = codec.decode_from_robot(sent[i])
            assert isinstance(command, Command)
            result = dispatch(registry, command, time.monotonic)
            assert isinstance(result, Result)
            return codec.encode(result)

        return handle

    requests = [_command(problem, "json").payload for problem in problems]

    def solver(i: int) -> Any:
        return solve_pnp(requests[i].points_world, requests[i].pixels, requests[i].camera)

    solved, *handled = _time_interleaved([solver, *(handler(name) for name in CODECS)], n)
    return [
        {
            "codec": name,
            "ratio_of": {name: float(np.median(times_us) / np.median(solved))},
            "matches": len(problems[0].pixels),
            "solver": spread(solved),
            "handler": spread(times_us),
        }
        for name, times_us in zip(CODECS, handled, strict=True)
    ]


def _command(problem: PnpProblem, codec: str) -> Command:
    request = make_request(problem.points_world, problem.pixels, problem.camera, binary=codec == "bin")
    return Command(id=1, service="pnp", payload=request, stream="front", seq=1, deadline_ms=250.0)


def _time_interleaved(calls: list[Callable[[int], Any]], n: int) -> list[list[float]]:
    """Return *n* times of each call, in microseconds; A B C A B C, so that neighbours hit all alike."""
    times: list[list[float]] = [[] for _ in calls]
    for i in range(n + PROBLEMS):
        for call, times_us in zip(calls, times, strict=True):
            started = time.thread_time_ns()
            call(i % PROBLEMS)
            times_us.append((time.thread_time_ns() - started) / 1e3)
    return [times_us[PROBLEMS:] for times_us in times]

"""CPU time of one PnP command on a server, stage by stage.

    python -m benchmarks solver.handler [--n 500]

Thread-CPU microseconds of each stage of the handler, every stage measured right after another
problem was solved, because code is slower when a solver has just used the caches.  The ratio of the
whole handler to the solver is in ``benchmarks/solver/codec.py``.  With the native core, decoding a message
makes the arrays, too.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated, Any

from benchmarks.frame.registry import benchmark
from benchmarks.frame.statistics import spread
from rse_pf.config import PlatformSettings
from rse_pf.pnp import PnpSolution, solve_pnp
from rse_pf.pnp.problems import PnpProblem, make_problem
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpReply, PnpRequest, make_request, wire_types
from rse_pf.wire import CODECS, Command, Result, as_type, make_codec

PROBLEMS = 32
MATCHES = 200


@benchmark()
def run_benchmark(*, n: Annotated[int, "samples of each stage"] = 500) -> dict[str, Any]:
    """Measure all stages with every codec."""
    problems = [make_problem(seed=seed, n=MATCHES) for seed in range(PROBLEMS)]
    return {"matches": MATCHES, "stages_us": {codec: stages(codec, problems, n) for codec in CODECS}}


def stages(codec_name: str, problems: list[PnpProblem], samples: int) -> dict[str, Any]:
    """Return the times of every stage."""
    codec = make_codec(codec_name, pnp=wire_types(builtin_services(PlatformSettings())))
    requests = [
        make_request(p.points_world, p.pixels, p.camera, binary=codec_name == "bin") for p in problems
    ]
    messages = [codec.encode(Command(id=1, service="pnp", payload=request)) for request in requests]
    commands = [codec.decode_from_robot(message) for message in messages]
    solutions = [solve_problem(problem) for problem in problems]
    results = [Result(id=1, reply=PnpReply.of(solution)) for solution in solutions]
    payloads = [command.payload for command in commands if isinstance(command, Command)]
    work: dict[str, Callable[[int], Any]] = {
        "decode message": lambda i: codec.decode_from_robot(messages[i]),
        "payload to arrays": lambda i: as_type(payloads[i], PnpRequest),
        "solve": lambda i: solve_problem(problems[i]),
        "solution to reply": lambda i: PnpReply.of(solutions[i]),
        "encode reply": lambda i: codec.encode(results[i]),
    }
    spent: dict[str, list[float]] = {stage: [] for stage in work}
    for sample in range(samples):
        for stage, run in work.items():
            solve_problem(problems[(sample + PROBLEMS // 2) % PROBLEMS])
            began = time.thread_time_ns()
            run(sample % PROBLEMS)
            spent[stage].append((time.thread_time_ns() - began) / 1e3)
    return {stage: spread(values) for stage, values in spent.items()}


def solve_problem(problem: PnpProblem) -> PnpSolution:
    """Solve with the service's defaults."""
    return solve_pnp(problem.points_world, problem.pixels, problem.camera)

"""CPU time of one PnP command on a server, stage by stage.

    python -m benchmarks.solver.handler [--n 500] [--out FILE]

Thread-CPU microseconds of each stage of the handler, every stage measured right after another
problem was solved, because code is slower when a solver has just used the caches.  The ratio of the
whole handler to the solver is in ``benchmarks/solver/codec.py``.  With the native core, decoding a message
makes the arrays, too.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.config import PlatformSettings
from rse_pf.pnp import PnpSolution, solve_pnp
from rse_pf.pnp.problems import PnpProblem, make_problem
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpReply, PnpRequest, make_request, wire_types
from rse_pf.wire import CODECS, Command, Result, as_type, make_codec

PROBLEMS = 32
MATCHES = 200
STAGES = ("decode message", "payload to arrays", "solve", "solution to reply", "encode reply")


def main() -> None:
    """Measure, print the table, write ``--out``."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=500, help="samples of each stage")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    args = parser.parse_args()
    problems = [make_problem(seed=seed, n=MATCHES) for seed in range(PROBLEMS)]
    report: dict[str, Any] = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "n": args.n,
        "matches": MATCHES,
        "load_before": os.getloadavg(),
        "stages_us": {codec: stages(codec, problems, args.n) for codec in CODECS},
        "load_after": os.getloadavg(),
    }
    print(f"{report['machine']}, n {args.n}, {MATCHES} matches, p50 / p95 / p99 us")
    print(f"{'stage':20}", *(f"{codec:>22}" for codec in CODECS))
    for stage in STAGES:
        cells = (" / ".join(f"{v:.0f}" for v in report["stages_us"][codec][stage]) for codec in CODECS)
        print(f"{stage:20}", *(f"{cell:>22}" for cell in cells))
    print(f"load average {report['load_before'][0]:.2f} before, {report['load_after'][0]:.2f} after")
    if args.out:
        args.out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def stages(codec_name: str, problems: list[PnpProblem], samples: int) -> dict[str, list[float]]:
    """Return p50, p95 and p99 of every stage."""
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
    return {stage: np.percentile(values, (50, 95, 99)).round(1).tolist() for stage, values in spent.items()}


def solve_problem(problem: PnpProblem) -> PnpSolution:
    """Solve with the service's defaults."""
    return solve_pnp(problem.points_world, problem.pixels, problem.camera)


if __name__ == "__main__":
    main()

"""Measure the whole handler against the bare solver call, interleaved in one process.

    python benchmarks/handler.py [--n 150] [--matches 200] [--outliers 0.3]

Prints machine, n, p50/p95/p99 of decode + dispatch + encode for each codec, and the ratio of the
medians to the bare solver.  Defends: `bin` <= 1.15x, `zlib` <= 1.4x of the bare solver (Sect. 6 of
the performance notes reached 1.05x and 1.34x).
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import sys
import time

from rse_pf.pnp import solve_pnp
from rse_pf.pnp.problems import make_problem
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import make_request
from rse_pf.settings import PlatformSettings
from rse_pf.wire import CODECS, Command, Result, make_codec


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=150)
    parser.add_argument("--matches", type=int, default=200)
    parser.add_argument("--outliers", type=float, default=0.3)
    options = parser.parse_args()
    registry = builtin_services(PlatformSettings())
    problem = make_problem(seed=7, n=options.matches, outlier_ratio=options.outliers)
    codecs = {name: make_codec(name) for name in CODECS}
    messages = {
        name: codec.encode(
            Command(
                id=1,
                service="pnp",
                payload=make_request(
                    problem.points_world, problem.pixels, problem.camera, binary=name == "bin"
                ),
            )
        )
        for name, codec in codecs.items()
    }
    times: dict[str, list[float]] = {name: [] for name in ("solver", *codecs)}
    for _ in range(options.n):
        began = time.thread_time()
        solve_pnp(problem.points_world, problem.pixels, problem.camera)
        times["solver"].append(time.thread_time() - began)
        for name, codec in codecs.items():
            began = time.thread_time()
            command = codec.decode_from_robot(messages[name])
            assert isinstance(command, Command)
            answer = dispatch(registry, command, time.monotonic)
            codec.encode(answer)
            times[name].append(time.thread_time() - began)
            assert isinstance(answer, Result), answer
    base = statistics.median(times["solver"])
    print(f"machine {platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"command {' '.join(sys.argv)}, n {options.n}, thread CPU us")
    for name, taken in times.items():
        taken.sort()
        p50, p95, p99 = (taken[int(q * len(taken))] * 1e6 for q in (0.5, 0.95, 0.99))
        size = len(messages[name]) if name in messages else 0
        print(
            f"{name:7} p50 {p50:6.0f}  p95 {p95:6.0f}  p99 {p99:6.0f}  "
            f"{statistics.median(taken) / base:.2f}x solver  {size} bytes"
        )


if __name__ == "__main__":
    main()

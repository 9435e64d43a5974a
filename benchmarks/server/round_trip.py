"""Round trip and CPU per command of a server, for each kind of command, alone or beside another checkout.

    python -m benchmarks server.round_trip [--base CHECKOUT] [--rounds 20] [--only echo pnp] [--scenario FILE]

========  ===========================================================================================
row       what robots send, binary
========  ===========================================================================================
echo      one robot, as fast as it is answered: 200 numbers
pnp       the same: real PnP, 200 matches, 30 % wrong, every frame kept
sandbox   the same: a service without state in Python, installed by an operator
keyframe  the same: keyframes of 600 generated features into a live map, acknowledged when durable
fleet     800 robots at 5 frames a second: real PnP as above
scenario  what a file of `rse-pf swarm` says, with ``--scenario``; alone
========  ===========================================================================================

CPU is user and system time of all processes of the server, idle ones included.  With ``--base``, a server
of this checkout and one of the other run at the same time, and the load generator turns from one to the
other: each round is a pair.  ``ratio`` is the median over the pairs, its error that of their mean.

Defends: no command costs more than 1.03 times the CPU that it did in the other checkout.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import interleaved, median_ratio
from benchmarks.server.load import LoadPlan, RobotGroup, compile_generator, plan_of, run_load, write_messages
from benchmarks.server.serving import UNLIMITED, BenchServer, cpu_of_tree_s
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.experiments.load.scenario import LoadScenario, read_scenario
from rse_pf.geometry import Camera, exp_se3
from rse_pf.services.custom.installed import install
from rse_pf.slam.keyframe import Keyframe, encode_keyframe, make_features
from rse_pf.wire import Command, make_codec

CODEC = "bin"
FLEET, FRAMES_PER_S = 800, 5.0
COUNT = """
import msgspec

class Request(msgspec.Struct):
    points: list[float]

class Reply(msgspec.Struct):
    count: int

def serve(request: Request) -> Reply:
    return Reply(count=len(request.points))
"""
SERVICE = '{"name": "count", "language": "python", "entry": "service.py", "kind": "stateless"}'
POINTS = 300
KEYFRAMES, FEATURES, STEP_M = 1000, 600, 0.1
"""Keyframes of one run: more than a server takes within it, since a robot sends none twice."""
STARTS_S = 1.5
"""Before a window: each connection is a robot of its own, whose sandbox starts first."""
CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
_FIRST_S = 5.0
"""Before the first window: the owner of the live map starts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredServer:
    """A server, its checkout, and the plan of each row."""

    name: str
    pid: int
    plans: dict[str, LoadPlan]


def plans_of(
    port: int, folder: Path, seconds: float, scenario: Path | None
) -> Iterator[tuple[str, LoadPlan]]:
    """Yield each row and its plan; payloads are written to *folder*."""
    if scenario is not None:
        yield "scenario", plan_of(read_scenario(scenario), folder, port)
        return
    one = LoadScenario(robots=1, seconds=seconds, codec=CODEC)
    for service in ("echo", "pnp"):
        plan = plan_of(replace(one, service=service), folder, port)
        yield service, replace(plan, groups=tuple(_closed(group.payload) for group in plan.groups))
    common = replace(plan, groups=(), warm_up_s=STARTS_S)
    points = {"points": [float(i % 7) for i in range(POINTS)]}
    yield "sandbox", replace(common, groups=(_closed(_file(folder, "count", [points])),))
    yield "keyframe", replace(common, groups=(_closed(_file(folder, "live-keyframe", keyframes())),))
    fleet = LoadScenario(robots=FLEET, fps=FRAMES_PER_S, seconds=seconds, codec=CODEC)
    yield "fleet", replace(plan_of(fleet, folder, port), sources=8)


def keyframes() -> Iterator[dict[str, Any]]:
    """Yield the requests of a robot that drives on and on."""
    rng = np.random.default_rng(7)
    for number in range(KEYFRAMES):
        features = make_features(
            rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (FEATURES, 2)),
            rng.uniform(0.5, 5.0, FEATURES), rng.integers(0, 256, (FEATURES, 32), dtype=np.uint8),
        )  # fmt: skip
        keyframe = Keyframe(
            timestamp_s=0.4 * number, T_odom_camera=exp_se3([STEP_M * number, 0, 0, 0, 0, 0]), camera=CAMERA,
            features=features,
        )  # fmt: skip
        yield {"map": "lab", "segment": 0, "number": number, "keyframe": encode_keyframe(keyframe)}


def _closed(payload: Path | None) -> RobotGroup:
    return RobotGroup(name="robots", robots=1, mode="closed", payload=payload)


def _file(folder: Path, service: str, payloads: Any) -> Path:
    codec = make_codec(CODEC)
    commands = (Command(id=n, service=service, payload=made, keep=True) for n, made in enumerate(payloads))
    return write_messages(folder / f"{service}.{CODEC}", (codec.encode(command) for command in commands))


def measure(server: MeasuredServer, row: str) -> dict[str, Any]:
    """Return what one run of *row* cost *server*."""
    cpu_s: dict[str, float] = {}
    report = run_load(server.plans[row], lambda mark: cpu_s.__setitem__(mark, cpu_of_tree_s(server.pid)))
    load = report.groups[0]
    if not load.ok or (row == "keyframe" and load.ok >= KEYFRAMES):
        raise ConfigurationError(f"{row}: {load.ok} commands were answered", hint=str(report)[:300])
    return {
        "row": row, "server": server.name, "ok": load.ok, "failed": load.failed, "lost": load.lost,
        "unsent": load.unsent, "cpu_us": 1e6 * (cpu_s["end"] - cpu_s["begin"]) / load.answered_in_window,
        "p50_ms": load.latency_ms.p50, "p99_ms": load.latency_ms.p99,
    }  # fmt: skip


def summarise(row: str, runs: list[dict[str, Any]], servers: list[MeasuredServer]) -> dict[str, Any]:
    """Return the medians of each server, and how much the first one costs beside the other."""
    of = {server.name: [run for run in runs if run["server"] == server.name] for server in servers}
    made: dict[str, Any] = {
        "row": row, "n": len(of[servers[0].name]),
        "not_ok": sum(run["failed"] + run["lost"] + run["unsent"] for run in runs),
    }  # fmt: skip
    for name, own in of.items():
        made[name] = {
            key: statistics.median(run[key] for run in own) for key in ("ok", "cpu_us", "p50_ms", "p99_ms")
        }
    if len(servers) > 1:
        here, base = ([run["cpu_us"] for run in of[server.name]] for server in servers)
        ratios = [a / b for a, b in zip(here, base, strict=True)]
        made |= {"ratio": median_ratio(here, base), "ratios": ratios}
        if len(ratios) > 1:
            made["ratio_error"] = statistics.stdev(ratios) / len(ratios) ** 0.5
    return made


@benchmark(Bar("rows.*.not_ok", equals=0), Bar("rows.*.ratio", at_most=1.03, unit="times the base"))
def run_benchmark(
    *,
    base: Annotated[Path | None, "a checkout with a .venv of its own, to compare with"] = None,
    rounds: Annotated[int, "runs of each row and server"] = 3,
    seconds: Annotated[float, "length of each run"] = 2.5,
    workers: Annotated[int, "worker processes of each server"] = 2,
    only: Annotated[tuple[str, ...], "rows"] = (),
    scenario: Annotated[Path | None, "drive what this file says, and nothing else"] = None,
) -> dict[str, Any]:
    """Measure each row on one server, or on two in turns."""
    compile_generator()
    rows, pythons = [], {"here": Path(sys.executable)}
    if base is not None:
        pythons["base"] = base / ".venv" / "bin" / "python"
        if not pythons["base"].exists():
            raise UsageError(f"there is no {pythons['base']}", hint="install the other checkout there")
    with tempfile.TemporaryDirectory() as made, ExitStack() as stack:
        servers = []
        for name, python in pythons.items():
            folder = Path(made) / name
            (folder / "count").mkdir(parents=True)
            (folder / "count" / "service.py").write_text(COUNT)
            (folder / "count" / "service.json").write_text(SERVICE)
            install(folder / "count", folder / "services")
            server = stack.enter_context(
                BenchServer(
                    folder, workers=workers, python=python, **UNLIMITED,
                    services={"folder": str(folder / "services"), "accept_weak_isolation": True},
                    data={"store": f"dir:{folder / 'objects'}"},
                )
            )  # fmt: skip
            plans = dict(plans_of(server.port, folder, seconds, scenario))
            servers.append(MeasuredServer(name=name, pid=server.pid, plans=plans))
        for row in servers[0].plans:
            if only and row not in only:
                continue
            for server in servers:
                run_load(replace(server.plans[row], warm_up_s=_FIRST_S))
            runs = []
            for _, server in interleaved(servers, rounds):
                runs.append(measure(server, row))
                say(runs[-1])
            rows.append(summarise(row, runs, servers))
    return {"rows": rows}

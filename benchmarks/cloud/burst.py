"""Robots at a server that is too small, with and without the burst function.

    python -m benchmarks cloud.burst [--robots 50] [--seconds 30] [--rate 8] [--deadline 0.3]
        [--emulated-cores 0.2] [--matches 200] [--budget N]

One server with a fifth of a core, and the function behind `lambda_pnp.local_front`, which plays firewall,
load balancer and Lambda.  Each robot is a `client_sdk.Robot` without a solver of its own; real PnP (200
matches, 30 % wrong), open loop: frames are due at fixed times, also while earlier ones wait.  First without
the function, then with it, by the address in the Welcome; then the server is stopped for the last third.
Answers are checked against the true poses.  The robots and the function share the machine's cores.

Defends: >= 99 % of the frames in time with the function (stated without); no more commands at the function
than the budget; every answer of it says ``lambda``.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import client_sdk
from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.errors import RsePfError
from rse_pf.pnp.problems import make_problem

__all__ = ["Outcome", "measure"]

BAR_PERCENT = 99.0
PROBLEMS = 16
LARGEST_M = 0.1
START_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    robots: int = 50
    seconds: float = 30.0
    rate: Annotated[float, "frames of a robot in a second"] = 8.0
    deadline: Annotated[float, "s"] = 0.3
    emulated_cores: float = 0.2
    matches: int = 200
    codec: str = "zlib"
    budget: Annotated[int, "commands of a robot in a day"] = 10_000


@dataclass(slots=True)
class Outcome:
    """What became of the frames of one run."""

    frames: int = 0
    in_time: int = 0
    wrong: int = 0
    sources: Counter[str] = field(default_factory=Counter)
    servers_of_burst: Counter[str] = field(default_factory=Counter)
    failures: Counter[str] = field(default_factory=Counter)
    round_trips_ms: list[float] = field(default_factory=list)
    at_function: int = 0
    most_of_a_robot: int = 0

    @property
    def percent(self) -> float:
        """The share of the frames that were answered in time."""
        return 100.0 * self.in_time / max(1, self.frames)

    def document(self) -> dict[str, Any]:
        """Return all of it as plain JSON values."""
        return {
            "frames": self.frames, "in_time_percent": round(self.percent, 2), "wrong": self.wrong,
            "answered_by": dict(self.sources), "servers_of_burst": dict(self.servers_of_burst),
            "failures": dict(self.failures), "commands_at_the_function": self.at_function,
            "most_commands_of_a_robot_there": self.most_of_a_robot,
            "ms": spread(self.round_trips_ms),
        }  # fmt: skip


def measure(args: Options, folder: Path) -> dict[str, Any]:
    """Run without the function, with it, and with it while the server dies; return what came of each."""
    key = SigningKey.from_seed(os.urandom(32), "bench")
    (folder / "keys.json").write_text(key.key_set().to_json(), encoding="utf-8")
    figures: dict[str, Any] = {}
    for name, has_burst, dies in (
        ("without", False, False), ("with", True, False), ("server dies", True, True),
    ):  # fmt: skip
        outcome = _run(args, folder, key, has_burst=has_burst, dies=dies)
        figures[name] = outcome.document()
        say({"run": name, **figures[name]})
    return figures


def _run(args: Options, folder: Path, key: SigningKey, *, has_burst: bool, dies: bool) -> Outcome:
    started: list[subprocess.Popen[bytes]] = []
    try:
        url = _start_front(args, folder, started) if has_burst else ""
        _write_settings(args, folder, url)
        server, port = _start_server(args, folder, started)
        robots = asyncio.run(_drive(args, key, f"ws://127.0.0.1:{port}/ws", server if dies else None))
    finally:
        for process in reversed(started):
            process.send_signal(signal.SIGTERM)
        for process in started:
            process.wait(30)
    return robots


def _write_settings(args: Options, folder: Path, url: str) -> None:
    settings = {"burst": {"url": url, "robot_commands_per_day": args.budget}}
    document = {"context": {"rse-pf": PlatformSettings.from_dict(settings).to_dict()}}
    (folder / "settings.json").write_text(json.dumps(document), encoding="utf-8")


def _start_front(args: Options, folder: Path, started: list[subprocess.Popen[bytes]]) -> str:
    _write_settings(args, folder, "")
    with (folder / "front.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "lambda_pnp.local_front", str(folder)], stdout=subprocess.PIPE, stderr=log
        )
    started.append(process)
    assert process.stdout is not None
    with process.stdout:  # it says nothing more
        line = process.stdout.readline()
    if not line:
        raise SystemExit(f"the function did not start: {(folder / 'front.log').read_text()}")
    url: str = json.loads(line)["url"]
    return url


def _start_server(
    args: Options, folder: Path, started: list[subprocess.Popen[bytes]]
) -> tuple[subprocess.Popen[bytes], int]:
    announce = folder / "server.json"
    announce.unlink(missing_ok=True)
    with (folder / "server.log").open("wb") as log:
        process = subprocess.Popen(
            [
                sys.executable, "-m", "rse_pf.cli.main", "serve", "--settings", str(folder / "settings.json"),
                "--keys", str(folder / "keys.json"), "--port", "0", "--control-port", "0", "--workers", "1",
                "--emulated-cores", str(args.emulated_cores), "--announce", str(announce),
            ],
            stdout=log, stderr=log,
        )  # fmt: skip
    started.append(process)
    deadline = time.monotonic() + START_S
    while not announce.exists():
        if time.monotonic() > deadline or process.poll() is not None:
            raise SystemExit(f"the server did not start: {(folder / 'server.log').read_text()}")
        time.sleep(0.05)  # polls, with a deadline
    return process, int(json.loads(announce.read_text(encoding="utf-8"))["port"])


async def _drive(args: Options, key: SigningKey, url: str, dying: subprocess.Popen[bytes] | None) -> Outcome:
    problems = [make_problem(seed=seed, n=args.matches) for seed in range(PROBLEMS)]
    settings, outcome = PlatformSettings().auth, Outcome()
    robots = [
        client_sdk.connect(
            url, token=key.issue(f"robot-{number}", now=time.time(), token_id=str(number), settings=settings),
            codec=args.codec, settings=SessionSettings(connect_timeout_s=20.0),
        )
        for number in range(args.robots)
    ]  # fmt: skip
    for robot in robots:
        await robot.__aenter__()
    begins = asyncio.get_running_loop().time() + 0.5
    if dying is not None:
        asyncio.get_running_loop().call_later(0.5 + args.seconds * 2 / 3, dying.kill)
    frames = int(args.seconds * args.rate)
    await asyncio.gather(
        *(
            _robot(args, robot, problems, begins + number / args.robots / args.rate, frames, outcome)
            for number, robot in enumerate(robots)
        )
    )
    outcome.at_function = sum(robot.stats.sent_to_burst for robot in robots)
    outcome.most_of_a_robot = max(robot.stats.sent_to_burst for robot in robots)
    for robot in robots:
        await robot.close()
    return outcome


async def _robot(
    args: Options, robot: client_sdk.Robot, problems: list[Any], begins: float, frames: int,
    outcome: Outcome,
) -> None:  # fmt: skip
    loop = asyncio.get_running_loop()
    asked = []
    for frame in range(frames):
        due = begins + frame / args.rate
        await asyncio.sleep(max(0.0, due - loop.time()))
        asked.append(loop.create_task(_frame(args, robot, problems[frame % PROBLEMS], due, outcome)))
    await asyncio.gather(*asked)


async def _frame(args: Options, robot: client_sdk.Robot, problem: Any, due: float, outcome: Outcome) -> None:
    loop = asyncio.get_running_loop()
    outcome.frames += 1
    try:
        left_s = max(0.001, due + args.deadline - loop.time())
        answer = await robot.solve_pnp(
            problem.points_world, problem.pixels, problem.camera, deadline_s=left_s, keep=True
        )
    except RsePfError as error:
        outcome.failures[error.code] += 1
        return
    took_s = loop.time() - due
    outcome.in_time += took_s <= args.deadline
    outcome.round_trips_ms.append(took_s * 1e3)
    outcome.sources[answer.source] += 1
    if answer.source == "burst":
        outcome.servers_of_burst[answer.server] += 1
    away = float(np.abs(answer.solution.T_camera_world - problem.T_camera_world).max())
    outcome.wrong += away > LARGEST_M


@benchmark(
    Bar("with.in_time_percent", at_least=BAR_PERCENT, unit="%"),
    Bar("with.wrong", equals=0),
    Bar("server dies.wrong", equals=0),
    Bar("answered_elsewhere", equals=0),
    Bar("above_budget", equals=0),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Run without the function, with it, and while the server dies."""
    with tempfile.TemporaryDirectory() as folder:
        figures = measure(args, Path(folder))
    helped = [figures["with"], figures["server dies"]]
    return {
        **figures,
        "answered_elsewhere": sum(set(run["servers_of_burst"]) != {"lambda"} for run in helped),
        "above_budget": sum(max(0, run["most_commands_of_a_robot_there"] - args.budget) for run in helped),
    }

"""Compare our server with the paper's own design (nginx, Lua, OpenCV) in one run, under the same load.

    python -m benchmarks server.peer FOLDER [--rounds 7] [--seconds 3.5]

*FOLDER* holds the sources of the paper's design, whose README lists the packages that the design needs; if
one is missing, a line names it and nothing is measured.  Each server has two workers.  The load is 200
matches, 30 and 50 % of them wrong, JSON+zlib and binary (the paper's design speaks JSON+zlib only): one robot
in a closed loop, and 100 robots at 5 frames a second in an open loop.  The servers take turns within each
round, so that a slower machine slows both.  CPU is user and system time of the whole process tree over the
answers that arrived meanwhile; the table shows medians of the rounds.

Defends the promised CPU time of a pose against the paper's design: CPU time per request >= 10 times less
(JSON+zlib) and 14 times (binary) at 30 %, 30 and 40 times at 50 %; p99 of 100 robots at 30 % >= 8 times
(JSON+zlib) and 12 times (binary) better, and <= 4 times the p50 of the same load.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import shutil
import socket
import statistics
import subprocess
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.server.load import (
    LoadPlan,
    RobotGroup,
    command_file,
    compile_generator,
    hello_file,
    run_load,
    write_messages,
)
from benchmarks.server.serving import UNLIMITED, BenchServer, cpu_of_tree_s
from rse_pf.errors import ConfigurationError
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.pnp.problems import make_problem

# Number of worker processes of each server.
WORKERS = 2
FRAMES_PER_S = 5.0
"""Frames that each of the `MANY` robots sends in a second: the rate of the paper (Sect. 6.2)."""
MANY = 100  # number of robots of the open loop
OUTLIERS = (0.3, 0.5)  # shares of wrong matches
PEER = "peer"  # name of the paper's design, which speaks JSON+zlib, in figures
ZLIB = "zlib"  # name of our server with JSON+zlib in figures
BINARY = "bin"  # name of our server with the binary codec in figures
# Names of the compared servers.
SYSTEMS = (PEER, ZLIB, BINARY)
PROBLEMS = 64  # number of different problems that the load repeats

# Files that the folder of the paper's design must hold.
_FILES = ("nginx.conf.tmpl", "pnp.lua", "pnp_so.cpp", "pnpmod.lua", "resty")
# Lua module of nginx, which the paper's design needs.
_MODULE = Path("/usr/lib/nginx/modules/ngx_http_lua_module.so")
# Headers of OpenCV, which the paper's design needs.
_HEADERS = Path("/usr/include/opencv4")
_START_S = 10.0  # time limit for the start and for the exit of nginx
_COMPILE_S = 120.0  # time limit for compiling the paper's design
_DRAIN_S = 1.5  # time after the window of a run, seconds; messages without an answer until then are lost


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredServer:
    """One of the compared servers: its port, its process, and the codec of the load generator for it."""

    codec: str
    port: int
    pid: int
    path: str
    hello: Path | None
    payloads: dict[float, Path]


def missing(folder: Path | None) -> str:
    """Return the name of what the paper's design lacks on this machine; empty if it can run."""
    if folder is None:
        return "no --peer FOLDER with the paper's design"
    lacks = [str(folder / name) for name in _FILES if not (folder / name).exists()]
    lacks += ["nginx"] if _nginx() is None else []
    lacks += [str(source) for source in (_MODULE, _HEADERS) if not source.exists()]
    lacks += ["g++"] if shutil.which("g++") is None else []
    return f"the paper's design lacks {', '.join(lacks)}" if lacks else ""


def _nginx() -> str | None:
    return shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def peer_file(folder: Path, outlier_ratio: float) -> Path:
    """Write the problems of `command_file` in the message format of the paper's design; return the file."""
    messages = []
    for seed in range(PROBLEMS):
        p = make_problem(seed=seed, outlier_ratio=outlier_ratio)
        document = {
            "cmd": "pnp", "id": seed, "K": [p.camera.fx, p.camera.fy, p.camera.cx, p.camera.cy],
            "p3": [round(float(v), 4) for v in p.points_world.ravel()],
            "p2": [round(float(v), 2) for v in p.pixels.ravel()],
        }  # fmt: skip
        messages.append(zlib.compress(json.dumps(document).encode(), 6))
    return write_messages(folder / f"peer-{round(100 * outlier_ratio)}", messages)


@contextlib.contextmanager
def paper_design(sources: Path, folder: Path) -> Iterator[tuple[int, int]]:
    """Build and run the paper's design in *folder*; yield its port and process id.

    Raises:
        ConfigurationError: The design cannot be compiled, or nginx does not start.
    """
    (folder / "lua").mkdir(parents=True)
    shutil.copytree(sources / "resty", folder / "lua" / "resty")
    shutil.copy(sources / "pnp.lua", folder)
    module = (sources / "pnpmod.lua").read_text().replace("@D@", str(folder))
    (folder / "lua" / "pnpmod.lua").write_text(module)
    port, text = _free_port(), (sources / "nginx.conf.tmpl").read_text()
    for mark, value in {"@D@": str(folder), "@PORT@": str(port), "@CACHE@": "on"}.items():
        text = text.replace(mark, value)
    (folder / "nginx.conf").write_text(text)
    command = [
        "g++", "-O2", "-shared", "-fPIC", f"-I{_HEADERS}", str(sources / "pnp_so.cpp"), "-o",
        str(folder / "libpnp.so"), "-lopencv_calib3d", "-lopencv_core",
    ]  # fmt: skip
    ended = subprocess.run(command, capture_output=True, text=True, timeout=_COMPILE_S, check=False)
    if ended.returncode:
        raise ConfigurationError("the paper's design cannot be compiled", hint=ended.stderr[:300])
    nginx = _nginx()
    assert nginx is not None
    with (folder / "output").open("wb") as output:
        process = subprocess.Popen(
            [nginx, "-c", folder / "nginx.conf", "-p", folder], stdout=output, stderr=output
        )
    try:
        until = time.monotonic() + _START_S
        while not _listens(port):
            if process.poll() is not None or time.monotonic() > until:
                log_text = (folder / "output").read_text(errors="replace")
                raise ConfigurationError("nginx does not start", hint=log_text[-300:])
            time.sleep(0.05)  # polls until the deadline
        yield port, process.pid
    finally:
        process.terminate()
        try:
            process.wait(_START_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1.0).close()
    except OSError:
        return False
    return True


def measure(
    server: MeasuredServer, outliers: float, robots: int, seconds: float, seed: int
) -> dict[str, Any]:
    """Return the figures of one run of *seconds*, with this share of wrong matches: *outliers*.

    A single robot sends after each answer; several send `FRAMES_PER_S` each.
    """
    cpu: dict[str, float] = {}
    group = RobotGroup(
        name="robots", robots=robots, mode="closed" if robots == 1 else "open",
        rate=0.0 if robots == 1 else FRAMES_PER_S, payload=server.payloads[outliers],
    )  # fmt: skip
    plan = LoadPlan(
        port=server.port, path=server.path, codec=server.codec, hello=server.hello, groups=(group,),
        seconds=seconds, drain_s=_DRAIN_S, seed=seed,
    )  # fmt: skip

    def at(mark: str) -> None:
        cpu[mark] = cpu_of_tree_s(server.pid)

    report = run_load(plan, at)
    if report.connected < robots:
        raise ConfigurationError(f"{report.connected} of {robots} robots are connected", hint=str(report))
    load = report.groups[0]
    answers = load.answered_in_window
    latency = load.latency_ms
    return {
        "system": server.codec, "outliers": outliers, "robots": robots, "ok": load.ok,
        "failed": load.failed, "lost": load.lost, "unsent": load.unsent,
        "cpu_us": 1e6 * (cpu["end"] - cpu["begin"]) / answers if answers else math.nan,
        "p50_ms": latency.p50, "p99_ms": latency.p99, "late_p99_ms": load.late_ms.p99,
        "generator_cpu_us": 1e6 * report.cpu_s / answers if answers else math.nan,
    }  # fmt: skip


def play(servers: list[MeasuredServer], rounds: int, seconds: float) -> list[dict[str, Any]]:
    """Measure every row *rounds* times; the servers take turns, in changing order."""
    rows = []
    for number in range(rounds):
        order = servers if number % 2 == 0 else servers[::-1]
        for outliers in OUTLIERS:
            for robots in (1, MANY):
                rows += [
                    {"round": number, **measure(server, outliers, robots, seconds, number + 1)}
                    for server in order
                ]
    return rows


def summarize(rounds: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row for each load and system: medians of the rounds, and ratios to the paper's design."""
    rows: list[dict[str, Any]] = []
    for outliers, robots in itertools.product(OUTLIERS, (1, MANY)):
        chosen = [window for window in rounds if (window["outliers"], window["robots"]) == (outliers, robots)]
        peer = _medians(chosen, PEER)
        for system in SYSTEMS:
            row = _medians(chosen, system)
            ratios = {
                "cpu_ratio": peer["cpu_us"] / row["cpu_us"],
                "p99_ratio": peer["p99_ms"] / row["p99_ms"],
            }
            rows.append({"outliers": outliers, "robots": robots, "system": system, **row, **ratios})
    return rows


def _medians(rounds: list[dict[str, Any]], system: str) -> dict[str, Any]:
    chosen = [window for window in rounds if window["system"] == system]
    times = ("cpu_us", "p50_ms", "p99_ms", "late_p99_ms", "generator_cpu_us")
    row: dict[str, Any] = {name: statistics.median(window[name] for window in chosen) for name in times}
    return row | {name: sum(window[name] for window in chosen) for name in ("ok", "failed", "lost", "unsent")}


def compared_figures(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return those figures of our server that have bars, by codec, share of wrong matches and robots."""
    return {
        f"{row['system']} {round(100 * row['outliers'])} % {row['robots']}": {
            "cpu_ratio": row["cpu_ratio"], "p99_ratio": row["p99_ratio"],
            "p99_over_p50": row["p99_ms"] / row["p50_ms"],
            "without_pose": row["failed"] + row["lost"] + row["unsent"],
        }
        for row in rows
        if row["system"] != PEER
    }  # fmt: skip


def run(sources: Path, rounds: int, seconds: float) -> dict[str, Any]:
    """Start both servers, measure, and return the report; raises ConfigurationError if one does not start."""
    compile_generator()
    with tempfile.TemporaryDirectory() as made, contextlib.ExitStack() as stack:
        folder = Path(made)
        (folder / "ours").mkdir()
        port, pid = stack.enter_context(paper_design(sources.resolve(), folder / "peer"))
        ours = stack.enter_context(BenchServer(folder / "ours", workers=WORKERS, **UNLIMITED))
        payloads = {outliers: peer_file(folder, outliers) for outliers in OUTLIERS}
        servers = [MeasuredServer(codec=PEER, port=port, pid=pid, path="/pnp", hello=None, payloads=payloads)]
        for codec in (ZLIB, BINARY):
            payloads = {
                outliers: command_file(folder, LoadScenario(codec=codec, outliers=outliers))
                for outliers in OUTLIERS
            }
            servers.append(
                MeasuredServer(
                    codec=codec, port=ours.port, pid=ours.pid, path="/ws", payloads=payloads,
                    hello=hello_file(folder, codec),
                )
            )  # fmt: skip
        for server in servers:
            measure(server, OUTLIERS[0], 1, 0.5, 0)  # warms the server up
        windows = play(servers, rounds, seconds)
    rows = summarize(windows)
    return {
        "settings": UNLIMITED, "rows": rows, "compared": compared_figures(rows), "rounds": windows,
    }  # fmt: skip


@benchmark(
    *(
        Bar(f"compared.{codec} {percent} % {robots}.cpu_ratio", at_least=bar)
        for codec, percent, bar in (
            ("zlib", 30, 10.0),
            ("bin", 30, 14.0),
            ("zlib", 50, 30.0),
            ("bin", 50, 40.0),
        )
        for robots in (1, MANY)
    ),
    Bar("compared.zlib 30 % 100.p99_ratio", at_least=8.0),
    Bar("compared.bin 30 % 100.p99_ratio", at_least=12.0),
    Bar("compared.zlib 30 % 100.p99_over_p50", at_most=4.0),
    Bar("compared.bin 30 % 100.p99_over_p50", at_most=4.0),
    Bar("compared.*.without_pose", at_most=0),
)
def run_benchmark(
    *, peer: Annotated[Path, "sources of the paper's design"], rounds: int = 7,
    seconds: Annotated[float, "of each run"] = 3.5,
) -> dict[str, Any]:  # fmt: skip
    """Measure both designs in turns."""
    reason = missing(peer)
    if reason:
        raise ConfigurationError(reason, hint=f"see the README of {peer}")
    return run(peer, rounds, seconds)

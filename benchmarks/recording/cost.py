"""What a recording costs: the same load on a platform that records and on one that does not, in turns.

    python -m benchmarks recording.cost [--seconds 60] [--rounds 3] [--robots 100] [--codec zlib]

Two platforms of the same build run at the same time (`rse-pf local`, two servers of one worker each, Envoy);
only one of them records.  Robots request 5 poses a second each (200 matches, 30 % wrong, every frame kept)
from one of them, then from the other: off, on, on, off ...  Latency counts from the planned time.  CPU time
is that of the processes of the platform that is asked, within the window: its workers, and all of them (load
balancer, control plane, supervisors, workers, recorders).  A ratio is the median over pairs of rounds.

Defends: recording costs the workers <= 5 % of CPU time, the whole platform <= 20 %; p99 <= 1.1 times; a file
has <= 12 kB for each command with its payload; no message is dropped.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import interleaved, median_ratio
from benchmarks.server.load import compile_generator, plan_of, run_load
from benchmarks.server.serving import tree
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.experiments.load.scenario import LoadScenario
from rse_pf.local.firewall import key_file, read_key
from rse_pf.local.state import PlatformState, read_state, state_folder

FRAMES_PER_S = 5.0
"""The paper's rate (Sect. 6.2)."""
SERVERS = 2
SETTINGS: dict[str, dict[str, Any]] = {"local": {"start_timeout_s": 120.0}}
"""A machine that is busy starts slowly; nothing else differs from the defaults."""
_START_S, _STOP_S = 180.0, 30.0
_LAST_CHUNK_S = 1.5
"""After a window, the recorder has written what it got."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    robots: int = 100
    seconds: Annotated[float, "of each round"] = 60.0
    rounds: Annotated[int, "pairs of rounds"] = 3
    codec: Literal["zlib", "json", "bin"] = "zlib"
    folder: Annotated[Path | None, "disk for recordings (default: that of temporary files)"] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSite:
    """One platform: its control plane, where robots connect, and its recordings, if it makes any."""

    pid: int
    state: PlatformState
    tokens: Path
    recordings: Path | None

    def cpu_s(self) -> tuple[float, float, float]:
        """Return the CPU seconds of the workers, of all processes, and of the recorders."""
        of_all = {pid: _cpu_s(pid) for pid in tree(self.pid)}
        of = {"rse-pf worker": 0.0, "rse-pf recorder": 0.0}
        for pid, cpu_s in of_all.items():
            of[_name(pid)] = of.get(_name(pid), 0.0) + cpu_s
        return of["rse-pf worker"], sum(of_all.values()), of["rse-pf recorder"]

    def recorded_bytes(self) -> int:
        """Return the size of its recordings."""
        return (
            0 if self.recordings is None else sum(path.stat().st_size for path in self.recordings.iterdir())
        )


def _cpu_s(pid: int) -> float:
    """Return the CPU seconds of one process by the scheduler's clock, which counts nanoseconds."""
    total = 0
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            total += int((task / "schedstat").read_text().split()[0])
    except OSError:  # it ended meanwhile
        return 0.0
    return total / 1e9


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


@contextmanager
def running(folder: Path, name: str, robots: int, recordings: Path | None) -> Iterator[RecordingSite]:
    """Yield a platform called *name*, which records if it has a folder for that; end it with the block."""
    environment = {**os.environ, "XDG_STATE_HOME": str(folder)}
    command = [
        sys.executable, "-m", "rse_pf.cli.main", "local", "--name", name, "--port", "0",
        "--metrics-port", "0", "--servers", str(SERVERS), "--no-data", "--no-page",
    ]  # fmt: skip
    if recordings is not None:
        command += ["--record", str(recordings)]
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log, cwd=folder)
    try:
        state = _wait_state(state_folder(name, environment), process)
        key = read_key(key_file(state_folder(name, environment)))
        auth = PlatformSettings().auth
        tokens = folder / f"{name}.tokens"
        tokens.write_text(
            "\n".join(
                key.issue(f"robot-{k}", now=time.time(), token_id=f"t-{k}", settings=auth)
                for k in range(robots)
            )
        )
        yield RecordingSite(pid=process.pid, state=state, tokens=tokens, recordings=recordings)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait_state(folder: Path, process: subprocess.Popen[bytes]) -> PlatformState:
    until = time.monotonic() + _START_S
    while time.monotonic() < until and process.poll() is None:
        state = read_state(folder)
        if state is not None and len([server for server in state.servers if server.port]) == SERVERS:
            return state
        time.sleep(0.05)  # looks again, with a deadline
    lines = (folder.parents[1] / f"{folder.name}.log").read_text(errors="replace").splitlines()
    raise ConfigurationError("a platform did not start", hint=" ".join(lines[-3:]))


def one_round(site: RecordingSite, folder: Path, asked: Options, seconds: float) -> dict[str, Any]:
    """Return what one window of load cost *site*."""
    marks: dict[str, tuple[float, float, float]] = {}
    bytes_before = site.recorded_bytes()
    scenario = LoadScenario(robots=asked.robots, fps=FRAMES_PER_S, seconds=seconds, codec=asked.codec)
    plan = replace(plan_of(scenario, folder, site.state.port), drain_s=2.0, tokens=site.tokens, sources=8)
    report = run_load(plan, lambda mark: marks.__setitem__(mark, site.cpu_s()))
    time.sleep(_LAST_CHUNK_S if site.recordings else 0.0)
    load = report.groups[0]
    workers_s, all_s, recorders_s = (marks["end"][k] - marks["begin"][k] for k in range(3))
    commands = max(1, load.ok + load.failed)
    # The commands of the warm-up are in the file, too.
    recorded = commands + asked.robots * FRAMES_PER_S * plan.warm_up_s
    return {
        "is_recording": site.recordings is not None, "commands": commands, "ok": load.ok,
        "not_ok": load.failed + load.lost + load.unsent, "p50_ms": load.latency_ms.p50,
        "p99_ms": load.latency_ms.p99, "workers_us": 1e6 * workers_s / commands,
        "platform_us": 1e6 * all_s / commands, "recorders_us": 1e6 * recorders_s / commands,
        "bytes": (site.recorded_bytes() - bytes_before) / recorded,
    }  # fmt: skip


def summary(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the ratios of recording to not recording: medians over pairs of rounds."""
    off = [pair for pair in rounds if not pair["is_recording"]]
    on = [pair for pair in rounds if pair["is_recording"]]
    pairs = list(zip(on, off, strict=True))

    def ratio(name: str) -> float:
        return median_ratio([a[name] for a, _ in pairs], [b[name] for _, b in pairs])

    row = {
        "workers": ratio("workers_us"), "platform": ratio("platform_us"), "p99": ratio("p99_ms"),
        "bytes": statistics.median(window["bytes"] for window in on),
    }  # fmt: skip
    return {**row, "pairs": len(pairs)}


def measure(asked: Options) -> dict[str, Any]:
    """Run all rounds; return the report."""
    rounds: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(dir=asked.folder) as made, ExitStack() as stack:
        folder = Path(made)
        (folder / "cdk.json").write_text(json.dumps({"context": {"rse-pf": SETTINGS}}))
        off = stack.enter_context(running(folder, "off", asked.robots, None))
        on = stack.enter_context(running(folder, "on", asked.robots, folder / "recordings"))
        for site in (off, on):
            one_round(site, folder, asked, 2.0)  # warms it up
        for _, site in interleaved((off, on), asked.rounds):
            rounds.append(one_round(site, folder, asked, asked.seconds))
            say(rounds[-1])
    return {"rounds": rounds, **summary(rounds)}


@benchmark(
    Bar("workers", at_most=1.05, unit="times the CPU"),
    Bar("platform", at_most=1.20, unit="times the CPU"),
    Bar("p99", at_most=1.1, unit="times"),
    Bar("bytes", at_most=12_000.0, unit="a command"),
)
def run_benchmark(asked: Options) -> dict[str, Any]:
    """Measure all rounds."""
    compile_generator()
    return measure(asked)

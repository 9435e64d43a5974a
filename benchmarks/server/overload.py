"""Measure the answers of an overloaded server: at 1.2, 1.5, 2 and 3 times the most robots that it carries.

    python -m benchmarks server.overload [--codec bin] [--frames kept] [--obey] [--most 1300] [--rounds 5]

The most robots are searched first, as in ``server.capacity``, unless ``--most`` names them: real PnP (200
matches, 30 % wrong) at 5 frames a second, two workers, no emulated cores; robots, server and load generator
share the cores.  Four fifths of these robots then drive all the time, together with robots that only send
pings; other robots join them for some seconds, up to each multiple.  Every command has a deadline of 250 ms.
``kept`` frames are never dropped; of ``newest`` frames a newer frame replaces one that still waits.

A command counts as answered if its pose arrived within 250 ms of its planned time.  Commands that the
generator could not send, or left out because it obeys ``retry_after_ms`` of a failure (``--obey``), count as
offered and not answered.  Recovery is the time from the end of the overload until 95 % of the commands of the
robots that stay are answered.

Defends the promise that at twice the load of best answers at least 80 % of these answers remain; pings are
answered in time.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import percentile
from benchmarks.server.capacity import FRAMES_PER_S, SOURCES, WARM_UP_S, ServingSite, find_capacity, serving
from benchmarks.server.load import (
    OUTCOMES,
    LoadPlan,
    LoadProcess,
    RobotGroup,
    command_file,
    compile_generator,
    hello_file,
    ping_file,
    read_samples,
    run_load,
)
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.load.scenario import LoadScenario

Frames = Literal["kept", "newest"]
MULTIPLES = (1.0, 1.2, 1.5, 2.0, 3.0)  # numbers of robots as multiples of the most that the server carries
STAYING_SHARE = 0.8  # share of the most robots that drive all the time; the others join them
DEADLINE_S = 0.25  # deadline of a command, and latest time at which its pose counts as an answer
PINGING_ROBOTS = 8  # number of robots that only send pings
PINGS_PER_S = 10.0  # pings per second of each pinging robot
RECOVERY_LIMIT_S = 3.0  # time after an overload for which the recovery of the server is observed
RECOVERY_STEP_S = 0.1  # resolution of the time of recovery
RECOVERY_WINDOW_S = 0.3  # time over which the share of answered commands is computed for the recovery
MIN_RECOVERED_SHARE = 0.95  # share of answered commands from which a server has recovered
LONGEST_S = 120.0  # longest run of the robots that stay
UNANSWERED_S = 10.0  # latency that a ping without an answer counts with
Samples = npt.NDArray[np.void]


def good(samples: Samples, begin_s: float, end_s: float) -> npt.NDArray[np.bool_]:
    """Return for each command planned in a time span whether its pose arrived within `DEADLINE_S`."""
    inside = planned_within(samples, 0, begin_s, end_s)
    is_pose: npt.NDArray[np.bool_] = inside["outcome"] == OUTCOMES.index("ok")
    return is_pose & (inside["latency_s"] <= DEADLINE_S)


def planned_within(samples: Samples, group: int, begin_s: float, end_s: float) -> Samples:
    """Return the messages of the group with an index that were planned from *begin_s* to before *end_s*."""
    planned_s = samples["planned_s"]
    return samples[(planned_s >= begin_s) & (planned_s < end_s) & (samples["group"] == group)]


def recovery_s(staying: Samples, end_s: float) -> float:
    """Return the seconds from *end_s* until staying robots are served again, at most `RECOVERY_LIMIT_S`."""
    for began_s in np.arange(end_s, end_s + RECOVERY_LIMIT_S - RECOVERY_WINDOW_S, RECOVERY_STEP_S):
        answered = good(staying, began_s, began_s + RECOVERY_WINDOW_S)
        if len(answered) and answered.mean() >= MIN_RECOVERED_SHARE:
            return float(began_s - end_s)
    return RECOVERY_LIMIT_S


def step(
    site: ServingSite, folder: Path, codec: str, robots: tuple[int, int], plan: tuple[Frames, bool, float]
) -> dict[str, Any]:
    """Overload a server by robots that join those that stay, and return the figures as a row.

    Args:
        site: The server.
        folder: Folder for the messages and samples.
        codec: Codec of the robots.
        robots: Number of robots that drive all the time, and number of robots that join them.
        plan: Which frames have to be answered, whether robots obey ``retry_after_ms``, and for how many
            seconds the others join.
    """
    frames, obeys, seconds = plan
    commands = LoadScenario(codec=codec, deadline_s=DEADLINE_S, keep=frames == "kept")
    payload = command_file(folder, commands)
    hello = hello_file(folder, codec)
    files = [folder / "staying.samples", folder / "joining.samples"]

    def made(name: str, count: int) -> RobotGroup:
        return RobotGroup(name=name, robots=count, mode="open", rate=FRAMES_PER_S, payload=payload)

    pings = RobotGroup(
        name="pings", robots=PINGING_ROBOTS, mode="open", rate=PINGS_PER_S, payload=ping_file(folder, codec)
    )
    common: dict[str, Any] = {
        "port": site.port, "path": site.path, "codec": codec, "hello": hello, "obeys": obeys,
        "sources": SOURCES, "warm_up_s": WARM_UP_S, "drain_s": 1.0, "opening_s": 30.0,
    }  # fmt: skip
    staying = LoadPlan(
        groups=(made("staying", robots[0]), pings), seconds=LONGEST_S, seed=1, samples=files[0], **common
    )
    joining = LoadPlan(
        groups=(made("joining", robots[1]),), seconds=seconds, seed=2, samples=files[1],
        first_source=1 + SOURCES, **common,
    )  # fmt: skip
    with LoadProcess(staying) as load:
        load.wait_begun()
        joined = run_load(joining)
        threading.Event().wait(RECOVERY_LIMIT_S)  # the time in which the server recovers
        stayed = load.stop()
    begin_s, end_s = joined.window_s
    both = [read_samples(file) for file in files]
    answered = np.concatenate([good(samples, begin_s, end_s) for samples in both])
    asked = planned_within(both[0], 1, begin_s, end_s)
    waits = np.where(asked["outcome"] == OUTCOMES.index("ok"), asked["latency_s"], UNANSWERED_S)
    return {
        "robots": sum(robots), "offered_per_s": len(answered) / seconds,
        "answered_per_s": float(answered.sum() / seconds),
        "ping_p99_ms": 1e3 * float(percentile(waits, 99)), "recovery_s": recovery_s(both[0], end_s),
        "joining": asdict(joined.groups[0]), "codes": joined.codes, "closed": joined.closed,
        "generator_cores": (joined.cpu_s + stayed.cpu_s) / seconds,
    }  # fmt: skip


@benchmark(
    Bar("answered_percent.at_1_2", at_least=95, unit="%"),
    Bar("answered_percent.at_1_5", at_least=90, unit="%"),
    Bar("answered_percent.at_2", at_least=80, unit="%"),
    Bar("answered_percent.at_3", at_least=65, unit="%"),
    Bar("ping_p99_ms", at_most=50, unit="ms"),
    Bar("recovery_s", at_most=1, unit="s"),
)
def run_benchmark(
    *,
    codec: Literal["zlib", "json", "bin"] = "bin",
    frames: Annotated[Frames, "which are to be answered"] = "kept",
    obey: Annotated[bool, "robots wait as long as a failure says"] = False,
    most: Annotated[int, "robots that the server carries; 0 searches them"] = 0,
    rounds: Annotated[int, "over all multiples"] = 1,
    seconds: Annotated[float, "of each overload"] = 4.0,
    multiples: Annotated[tuple[float, ...], "of the most robots; the first is 1"] = MULTIPLES,
) -> dict[str, Any]:
    """Search the most robots that a server carries, and overload the server by each multiple."""
    if most < 0:
        raise UsageError(f"--most {most} is below 0", hint="name a number of robots, or 0")
    compile_generator()
    steps: list[dict[str, Any]] = []
    with serving(2) as (server, folder):
        site = ServingSite(port=server.port, path="/ws", workers=2)
        most = most or int(find_capacity(site, folder, codec, seconds)["robots"])
        stay = round(STAYING_SHARE * most)
        for number in range(rounds):
            for multiple in multiples:
                with tempfile.TemporaryDirectory() as made:
                    robots = (stay, round(multiple * most) - stay)
                    row = step(site, Path(made), codec, robots, (frames, obey, seconds))
                steps.append({"round": number, "multiple": multiple, **row})
                say(
                    f"{multiple:g} x {most}: {row['answered_per_s']:.0f} of {row['offered_per_s']:.0f} "
                    f"a second, pings {row['ping_p99_ms']:.0f} ms, back in {row['recovery_s']:.1f} s, "
                    f"{row['codes']}"
                )
    return {"most": most, "cores": os.cpu_count(), **summary(steps), "steps": steps}


def name_of(multiple: float) -> str:
    """Return the name of a multiple in figures, without a dot, since dots separate the names in bars."""
    return f"at_{multiple:g}".replace(".", "_")


def summary(steps: list[dict[str, Any]]) -> dict[str, Any]:
    """Return medians over rounds: answered commands, in percent of those at the limit, pings and recovery."""

    def median(multiple: float) -> float:
        return statistics.median(row["answered_per_s"] for row in steps if row["multiple"] == multiple)

    beyond = [row for row in steps if row["multiple"] > 1.0]
    return {
        "answered_per_s": median(1.0),
        "answered_percent": {
            name_of(each): 100 * median(each) / median(1.0)
            for each in sorted({row["multiple"] for row in beyond})
        },
        "ping_p99_ms": statistics.median(row["ping_p99_ms"] for row in beyond),
        "recovery_s": max(row["recovery_s"] for row in beyond),
    }

"""What a server answers beyond its limit: at 1.2, 1.5, 2 and 3 times the most robots that it carries.

    python -m benchmarks server.overload [--codec bin] [--frames kept] [--obey] [--most 1300] [--rounds 5]

The most robots are searched first, as in ``server.capacity``, unless ``--most`` names them: real PnP (200
matches, 30 % wrong) at 5 frames a second, two workers, no emulated cores; robots, server and load generator
share the cores.  Four fifths of them then drive all the time, with robots that only ping; others join them
for some seconds, up to each multiple.  Every command has a deadline of 250 ms.  ``kept`` frames are all to be
answered, of ``newest`` ones a newer frame of the camera takes the place of one that waits.

A command counts as answered if its pose came within 250 ms of its planned time.  What the generator could not
send, or left out because it obeys a failure's ``retry_after_ms`` (``--obey``), is offered and not answered.
Recovery is the time from the end of the overload until 95 % of the remaining robots' commands are answered.

Defends: a server beyond its limit answers nearly as much as at its limit, and its pings do not wait.
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
MULTIPLES = (1.0, 1.2, 1.5, 2.0, 3.0)
SHARE_THAT_STAYS = 0.8
DEADLINE_S = 0.25
PINGING, PINGS_PER_S = 8, 10.0
AFTERWARDS_S, STEP_S, LOOKED_AT_S, RECOVERED = 3.0, 0.1, 0.3, 0.95
LONGEST_S = 120.0
UNANSWERED_S = 10.0
"""What a ping without an answer counts as."""
Samples = npt.NDArray[np.void]


def good(samples: Samples, begin_s: float, end_s: float) -> npt.NDArray[np.bool_]:
    """Return for each command that was planned within a time whether its pose came within `DEADLINE_S`."""
    inside = planned_within(samples, 0, begin_s, end_s)
    is_pose: npt.NDArray[np.bool_] = inside["outcome"] == OUTCOMES.index("ok")
    return is_pose & (inside["latency_s"] <= DEADLINE_S)


def planned_within(samples: Samples, group: int, begin_s: float, end_s: float) -> Samples:
    """Return the messages of one group that were planned within a time."""
    planned_s = samples["planned_s"]
    return samples[(planned_s >= begin_s) & (planned_s < end_s) & (samples["group"] == group)]


def recovery_s(staying: Samples, end_s: float) -> float:
    """Return the time from *end_s* until robots that stayed are served again, at most `AFTERWARDS_S`."""
    for began_s in np.arange(end_s, end_s + AFTERWARDS_S - LOOKED_AT_S, STEP_S):
        answered = good(staying, began_s, began_s + LOOKED_AT_S)
        if len(answered) and answered.mean() >= RECOVERED:
            return float(began_s - end_s)
    return AFTERWARDS_S


def step(
    site: ServingSite, folder: Path, codec: str, robots: tuple[int, int], plan: tuple[Frames, bool, float]
) -> dict[str, Any]:
    """Let the first number of robots drive, the second join them, and return what came of it.

    Args:
        site: The server.
        folder: For files.
        codec: Of the robots.
        robots: How many drive all the time, and how many join them.
        plan: Which frames are answered, whether robots obey, and for how many seconds the others join.
    """
    frames, obeys, seconds = plan
    commands = LoadScenario(codec=codec, deadline_s=DEADLINE_S, keep=frames == "kept")
    payload = command_file(folder, commands)
    hello = hello_file(folder, codec)
    files = [folder / "staying.samples", folder / "joining.samples"]

    def made(name: str, count: int) -> RobotGroup:
        return RobotGroup(name=name, robots=count, mode="open", rate=FRAMES_PER_S, payload=payload)

    pings = RobotGroup(
        name="pings", robots=PINGING, mode="open", rate=PINGS_PER_S, payload=ping_file(folder, codec)
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
        threading.Event().wait(AFTERWARDS_S)  # the time in which the server recovers
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
    """Search the most robots, and go beyond them."""
    if most < 0:
        raise UsageError(f"--most {most} is less than nothing", hint="name a number of robots, or 0")
    compile_generator()
    steps: list[dict[str, Any]] = []
    with serving(2) as (server, folder):
        site = ServingSite(port=server.port, path="/ws", workers=2)
        most = most or int(find_capacity(site, folder, codec, seconds)["robots"])
        stay = round(SHARE_THAT_STAYS * most)
        for number in range(rounds):
            for multiple in multiples:
                with tempfile.TemporaryDirectory() as made:
                    robots = (stay, round(multiple * most) - stay)
                    told = step(site, Path(made), codec, robots, (frames, obey, seconds))
                steps.append({"round": number, "multiple": multiple, **told})
                say(
                    f"{multiple:g} x {most}: {told['answered_per_s']:.0f} of {told['offered_per_s']:.0f} a "
                    f"second, pings {told['ping_p99_ms']:.0f} ms, back in {told['recovery_s']:.1f} s, "
                    f"{told['codes']}"
                )
    return {"most": most, "cores": os.cpu_count(), **summary(steps), "steps": steps}


def name_of(multiple: float) -> str:
    """Return the name of a multiple in figures: dots part names of bars."""
    return f"at_{multiple:g}".replace(".", "_")


def summary(steps: list[dict[str, Any]]) -> dict[str, Any]:
    """Return medians over rounds: answered commands in percent of those at the most, pings, recovery."""

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

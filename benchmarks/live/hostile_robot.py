"""A hostile robot in one's own live map: what is left of it after it is forgotten, and what it costs others.

Three honest robots drive through a generated building beside one that lies in one of several ways.  The same
map without that robot has the same links between the others, so joins and errors can be compared exactly.
What an honest keyframe costs is compared with the map in which the fourth robot drives as far, and tells the
truth.

    python -m benchmarks live.hostile_robot --seeds 20
    python -m benchmarks live.hostile_robot --forget 1000
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import percentile, spread
from benchmarks.live.generated_drives import GeneratedDrive, GeneratedWorld, circle
from rse_pf.experiments.results.trajectory_error import ate_m
from rse_pf.geometry import Array, exp_se3
from rse_pf.live_map.events import (
    Event,
    KeyframeAdded,
    LinksMeasured,
    RobotForgotten,
)
from rse_pf.live_map.live_map import LiveMap
from rse_pf.slam.keyframe import encode_keyframe

__all__ = ["ATTACKS", "HOSTILE", "Judged", "Played", "judge", "play", "scenario", "without"]

HOSTILE = "x"
ATTACKS = ("random-odometry", "mirrored-views", "lookalikes", "scaled-rotations")
_HONEST = ("a", "b", "c")


@dataclass(slots=True, eq=False)
class Played:
    """A map, the ids of its honest keyframes, and the CPU time of each of them with its links."""

    live_map: LiveMap
    ids: list[int]
    honest_ms: list[float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """A hostile robot's damage: joins and errors after it was forgotten, against the map without it."""

    same_joins: bool
    ate_cm: float
    ate_without_cm: float
    forget_s: float
    slower_p50: float
    slower_p99: float


def scenario(attack: str, seed: int, rounds: float = 1.5) -> tuple[list[Event], Array]:
    """Return the events of three honest robots and a hostile one, and the ``(n, 4, 4)`` true poses by id."""
    world = GeneratedWorld(seed=seed, links=6)
    begin = world.rng.uniform(0.0, 6.0)
    honest = [
        world.drive(name, circle(0.8, rounds, phase=begin + phase))
        for name, phase in zip(_HONEST, (0.0, 2.0, 4.0), strict=True)
    ]
    lying = _lying(world, attack, circle(0.8, rounds, phase=begin + 1.0))
    events: list[Event] = []
    for event in world.play([*honest, lying]):
        if isinstance(event, KeyframeAdded) and event.robot == HOSTILE:
            T = event.keyframe.T_odom_camera.copy()
            if attack == "scaled-rotations":
                T[:3, :3] *= np.sqrt(1.0 + world.rng.uniform(-1.9e-3, 1.9e-3))
            data = encode_keyframe(dataclasses.replace(event.keyframe, T_odom_camera=T))
            event = msgspec.structs.replace(event, data=data)
        events.append(event)
    return events, np.array(world.seen)


def _lying(world: GeneratedWorld, attack: str, positions: Array) -> GeneratedDrive:
    drive = world.drive(HOSTILE, positions)
    odometry, half = drive.T_odom_camera.copy(), 3 * len(positions) // 4
    if attack == "random-odometry":
        for number in range(1, len(odometry)):
            step = np.r_[world.rng.uniform(-2.0, 2.0, 3), world.rng.uniform(-1.0, 1.0, 3)]
            odometry[number] = odometry[number - 1] @ exp_se3(step)
    elif attack == "lookalikes":  # its first views again, as if they lay 15 m away
        seen = drive.T_world_camera.copy()
        again = len(seen) - half
        seen[half:] = seen[:again]
        shift = np.eye(4)
        shift[0, 3] = 15.0
        odometry[half:] = shift @ odometry[:again]
        return GeneratedDrive(robot=HOSTILE, T_world_camera=seen, T_odom_camera=odometry)
    elif attack == "mirrored-views":  # a mirror image moves to the other side what was on one
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        odometry = mirror @ odometry @ mirror
    return dataclasses.replace(drive, T_odom_camera=odometry)


def without(events: Sequence[Event], robot: str) -> list[Event]:
    """Return *events* as they are without *robot*: keyframes are numbered anew, links to it are left out."""
    number_of: dict[int, int] = {}
    others: list[Event] = []
    count = 0
    for event in events:
        if isinstance(event, KeyframeAdded):
            if event.robot != robot:
                number_of[count] = len(number_of)
                others.append(event)
            count += 1
        elif isinstance(event, LinksMeasured) and event.keyframe in number_of:
            links = tuple(
                msgspec.structs.replace(link, other=number_of[link.other])
                for link in event.links if link.other in number_of
            )  # fmt: skip
            others.append(LinksMeasured(keyframe=number_of[event.keyframe], links=links))
    return others


def play(events: Sequence[Event]) -> Played:
    """Return the map of *events*."""
    played = Played(LiveMap(), [], [])
    robots: list[str] = []
    for event in events:
        begin = time.process_time()
        played.live_map.apply(event)
        took_ms = 1e3 * (time.process_time() - begin)
        if isinstance(event, KeyframeAdded):
            robots.append(event.robot)
            if event.robot != HOSTILE:
                played.ids.append(len(robots) - 1)
                played.honest_ms.append(took_ms)
        elif isinstance(event, LinksMeasured) and robots[event.keyframe] != HOSTILE:
            played.honest_ms[-1] += took_ms
    return played


def joins(live_map: LiveMap) -> dict[str, bool]:
    """Return which honest robots are in the map."""
    return {
        alignment.robot: alignment.aligned
        for alignment in live_map.alignments()
        if alignment.robot != HOSTILE
    }


def error_cm(played: Played, true: Array) -> float:
    """Return the error of the honest keyframes after a whole optimisation."""
    played.live_map.apply(played.live_map.optimise())
    poses = np.array([played.live_map.pose(i) for i in played.ids])
    return 100.0 * ate_m(poses, true)


def judge(attack: str, seed: int) -> Judged:
    """Play an attack, forget who made it, and compare: errors without it, times with an honest robot."""
    events, true = scenario(attack, seed)
    clean, attacked = play(without(events, HOSTILE)), play(events)
    behaved = play(scenario("none", seed)[0])
    begin = time.process_time()
    attacked.live_map.apply(RobotForgotten(robot=HOSTILE))
    forget_s = time.process_time() - begin
    same = joins(attacked.live_map) == joins(clean.live_map)
    p50, p99 = (float(percentile(attacked.honest_ms, q) / percentile(behaved.honest_ms, q)) for q in (50, 99))
    return Judged(
        same_joins=same, ate_cm=error_cm(attacked, true[attacked.ids]),
        ate_without_cm=error_cm(clean, true[attacked.ids]), forget_s=forget_s, slower_p50=p50, slower_p99=p99,
    )  # fmt: skip


def forget_s(keyframes: int) -> float:
    """Return the CPU time to forget a robot with so many keyframes beside three honest ones."""
    world = GeneratedWorld(seed=1, links=3)
    honest = [world.drive(name, circle(2.0, 1.0, phase=2.0 * row)) for row, name in enumerate(_HONEST)]
    rounds = 1.01 * keyframes * 0.1 / (2.0 * np.pi * 2.0)
    lying = world.drive(HOSTILE, circle(2.0, rounds)[:keyframes])
    played = play([*world.play([*honest, lying])])
    begin = time.process_time()
    played.live_map.apply(RobotForgotten(robot=HOSTILE))
    return time.process_time() - begin


@benchmark(
    Bar("forget_s", at_most=5.0, unit="s of CPU"),
    Bar("attacks.*.other_joins", equals=0),
    Bar("attacks.*.ate_differs_cm.max", at_most=0.1, unit="cm"),
    Bar("attacks.*.honest_p99_ratio", at_most=2.0, unit="times"),
)
def run_benchmark(
    *, seeds: int = 20, forget: Annotated[int, "keyframes of a robot to forget instead"] = 0
) -> dict[str, Any]:
    """Judge all attacks, or forget one large robot."""
    if forget:
        return {"keyframes": forget, "forget_s": forget_s(forget)}
    figures = {}
    for attack in ATTACKS:
        verdicts = [judge(attack, seed) for seed in range(seeds)]
        figures[attack] = {
            "n": len(verdicts), "other_joins": sum(not verdict.same_joins for verdict in verdicts),
            "ate_differs_cm": spread(abs(verdict.ate_cm - verdict.ate_without_cm) for verdict in verdicts),
            "honest_p50_ratio": float(np.median([verdict.slower_p50 for verdict in verdicts])),
            "honest_p99_ratio": float(np.median([verdict.slower_p99 for verdict in verdicts])),
            "forget_s": spread(verdict.forget_s for verdict in verdicts),
        }  # fmt: skip
        say({"attack": attack, **figures[attack]})
    return {"attacks": figures}

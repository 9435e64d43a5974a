"""Events of three honest robots in a generated building and of one that lies, and the map that they make."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from client_sdk.trajectory_error import ate_m
from rse_pf.geometry import Array, exp_se3
from rse_pf.live_map.events import Event, KeyframeAdded, LoopClosuresMeasured
from rse_pf.live_map.live_map import LiveMap
from rse_pf.slam.keyframe import encode_keyframe
from tests.kit.generated_drives import GeneratedDrive, GeneratedWorld, circle

HOSTILE = "x"
_HONEST = ("a", "b", "c")


@dataclass(slots=True, eq=False)
class Played:
    """A map, and the ids of its honest keyframes."""

    live_map: LiveMap = field(default_factory=LiveMap)
    ids: list[int] = field(default_factory=list)


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
    elif attack == "aliases":  # its first views again, as if they lay 15 m away
        seen = drive.T_world_camera.copy()
        again = len(seen) - half
        seen[half:] = seen[:again]
        shift = np.eye(4)
        shift[0, 3] = 15.0
        odometry[half:] = shift @ odometry[:again]
        return GeneratedDrive(robot=HOSTILE, T_world_camera=seen, T_odom_camera=odometry)
    return dataclasses.replace(drive, T_odom_camera=odometry)


def without(events: Sequence[Event], robot: str) -> list[Event]:
    """Return *events* without those of *robot*, and without loop closures with it; ids are counted anew."""
    number_of: dict[int, int] = {}
    others: list[Event] = []
    count = 0
    for event in events:
        if isinstance(event, KeyframeAdded):
            if event.robot != robot:
                number_of[count] = len(number_of)
                others.append(event)
            count += 1
        elif isinstance(event, LoopClosuresMeasured) and event.keyframe in number_of:
            links = tuple(
                msgspec.structs.replace(link, other=number_of[link.other])
                for link in event.links if link.other in number_of
            )  # fmt: skip
            others.append(LoopClosuresMeasured(keyframe=number_of[event.keyframe], links=links))
    return others


def play(events: Sequence[Event]) -> Played:
    """Return the map of *events*."""
    played, keyframes = Played(), 0
    for event in events:
        played.live_map.apply(event)
        if isinstance(event, KeyframeAdded):
            if event.robot != HOSTILE:
                played.ids.append(keyframes)
            keyframes += 1
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

"""The live map in one process, without a platform: accuracy, joins, wrong links, replay and growth.

Recordings are tracked by the product's `Tracker`; poses are solved in this process, and corrections reach a
robot two frames late.  Ground truth is used for errors only.

    python -m benchmarks.live.one_process kitchen --recordings ../shared/data --runs 10
    python -m benchmarks.live.one_process foreign --recordings ../shared/data --runs 20
    python -m benchmarks.live.one_process wrong | twins | replay | growth
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.live.generated_drives import (
    GeneratedDrive,
    GeneratedWorld,
    circle,
    make_link,
    meander,
    straight,
)
from benchmarks.maps.recordings import Run, drive, frame_poses, red_kitchen, truth_of
from client_sdk.datasets import Dataset, open_dataset
from client_sdk.frontend import FrontEndOptions
from rse_pf.experiments.results.trajectory_error import ate_m
from rse_pf.geometry import Array, exp_se3, inverse
from rse_pf.live_map.events import Event, KeyframeAdded, LinksMeasured, MapStarted
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.live_map.outcomes import (
    Added,
    Ambiguous,
    Corrected,
    Joined,
    LinkRemoved,
    OptimiseWanted,
    Outcome,
    Unaligned,
)
from rse_pf.live_map.versions import encode_stored

__all__ = ["Played", "main", "play"]

DENSE = FrontEndOptions(is_spread=False, keyframe_m=0.1, keyframe_deg=6.0)
LATE_FRAMES = 2
KITCHEN_CUTS = {"a": range(84), "b": range(84, 168), "c": range(168, 250)}
FOREIGN = ("redwood_living_room", "nyu_dining_room", "tum_fr1_xyz_start", "7scenes_redkitchen")


@dataclass(slots=True, eq=False)
class Played:
    """What robots in one live map got: poses as given out, the frame of each join, and the map at the end."""

    live_map: LiveMap
    ids: dict[str, list[int]] = field(default_factory=dict)
    given: dict[str, dict[int, Array]] = field(default_factory=dict)
    outcomes: list[Outcome] = field(default_factory=list)
    measure_ms: list[float] = field(default_factory=list)

    def online_cm(self, truth: Mapping[str, Array]) -> float:
        """Return the error of the poses as they were given out."""
        rows = {name: sorted(errors_cm) for name, errors_cm in self.given.items() if errors_cm}
        given = np.array([self.given[name][row] for name in rows for row in rows[name]])
        return 100.0 * ate_m(given, np.concatenate([truth[name][rows[name]] for name in rows]))

    def final_cm(self, runs: Mapping[str, Run], truth: Mapping[str, Array]) -> float:
        """Return the error of all frames in the map at the end."""
        poses = [
            frame_poses(run, np.array([self.live_map.pose(i) for i in self.ids[name]]))
            for name, run in runs.items()
        ]
        return 100.0 * ate_m(np.concatenate(poses), np.concatenate([truth[name] for name in runs]))

    def joined_at(self) -> dict[str, int]:
        """Return the own frame from which on each robot knew its place."""
        return {name: min(frames) for name, frames in self.given.items() if frames}


def play(runs: Mapping[str, Run], starts: Mapping[str, int], options: LiveMapOptions | None = None) -> Played:
    """Let robots drive at the same time, each from its own start (frames), into one live map."""
    played = Played(live_map=LiveMap(options))
    known: dict[str, Array | None] = dict.fromkeys(runs)
    under_way: list[tuple[int, str, Array | None]] = []
    for name in runs:
        played.ids[name], played.given[name] = [], {}
    for tick in range(max(starts[name] + len(runs[name].stamps_s) for name in runs)):
        for _, name, T_map_odom in [waiting for waiting in under_way if waiting[0] <= tick]:
            known[name] = T_map_odom
        under_way = [waiting for waiting in under_way if waiting[0] > tick]
        for name, run in runs.items():
            row = tick - starts[name]
            if not 0 <= row < len(run.stamps_s):
                continue
            T_map_odom = known[name]
            if T_map_odom is not None:
                played.given[name][row] = T_map_odom @ run.T_world_camera[row]
            number = int(run.keyframe_of_frame[row])
            if number == len(played.ids[name]):
                under_way += _send(played, name, run, number, tick)
    return played


def _send(played: Played, name: str, run: Run, number: int, tick: int) -> list[tuple[int, str, Array | None]]:
    """Send a keyframe, measure it, and return what robots learn of it, and when."""
    keyframe = run.version.keyframes[number]
    event = KeyframeAdded(
        robot=name, segment=0, number=number, data=encode_stored(keyframe)
    )  # fmt: skip
    outcomes = played.live_map.apply(event)
    added = next(outcome for outcome in outcomes if isinstance(outcome, Added))
    played.ids[name].append(added.id)
    begin = time.process_time()
    links = played.live_map.measure(added.id)
    played.measure_ms.append(1000.0 * (time.process_time() - begin))
    outcomes = [*outcomes, *played.live_map.apply(links)]
    if any(isinstance(outcome, OptimiseWanted) for outcome in outcomes):
        outcomes = [*outcomes, *played.live_map.apply(played.live_map.optimise())]
    played.outcomes += outcomes
    alignments: list[tuple[int, str, Array | None]] = []
    for outcome in outcomes:
        if isinstance(outcome, Corrected):
            alignments.append((tick + LATE_FRAMES, outcome.robot, outcome.T_map_odom))
        elif isinstance(outcome, Unaligned):
            alignments.append((tick + LATE_FRAMES, outcome.robot, None))
    return alignments


def kitchen(recordings: Path, runs: int) -> None:
    """State the accuracy of one robot and of three in the red kitchen."""
    dataset = red_kitchen(recordings)
    whole = {"whole": drive(dataset, range(len(dataset)), "whole", DENSE)}
    three = {name: drive(dataset, rows, name, DENSE) for name, rows in KITCHEN_CUTS.items()}
    truth = {name: truth_of(dataset, run.stamps_s) for name, run in (whole | three).items()}
    played = play(whole, {"whole": 0})
    print(
        f"one robot: final {played.final_cm(whole, truth):.2f} cm, online {played.online_cm(truth):.2f} cm, "
        f"frame to frame {100.0 * ate_m(whole['whole'].T_world_camera, truth['whole']):.2f} cm"
    )
    final, online, last, share = [], [], [], []
    for seed in range(runs):
        at = np.random.default_rng(seed).integers(0, 60, 3)
        starts = dict(zip(three, (at - at.min()).tolist(), strict=True))
        played = play(three, starts)
        joined = played.joined_at()
        if len(joined) < 3:
            print(f"seed {seed}: only {sorted(joined)} joined: not scored")
            continue
        final.append(played.final_cm(three, truth))
        online.append(played.online_cm(truth))
        last.append(max(joined.values()))
        share.append(
            sum(map(len, played.given.values())) / sum(len(run.stamps_s) for run in three.values())
        )  # fmt: skip
    print(
        f"three robots, {len(final)} of {runs} runs: final mean {np.mean(final):.2f} max {max(final):.2f}, "
        f"online mean {np.mean(online):.2f} max {max(online):.2f} cm, last join at own frame {max(last)}, "
        f"given out aligned {100.0 * np.mean(share):.0f} % (least {100.0 * min(share):.0f} %)"
    )


def foreign(recordings: Path, runs: int) -> None:
    """State how many robots of unrelated recordings join each other."""
    drives: dict[str, Run] = {}
    for name in FOREIGN:
        dataset: Dataset = open_dataset(recordings / name)
        wide = FrontEndOptions.wide_baseline() if name.startswith("nyu") else DENSE
        drives[name] = drive(dataset, range(min(len(dataset), 84)), name, wide)
    wrong = links = 0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        starts = {name: int(rng.integers(0, 40)) for name in rng.permutation(list(drives)).tolist()}
        played = play({name: drives[name] for name in starts}, starts)
        wrong += sum(isinstance(outcome, Joined) for outcome in played.outcomes) - 1
        links += played.live_map.links_open
    keyframes = {name: len(run.version.keyframes) for name, run in drives.items()}
    print(f"unrelated recordings {keyframes}, {runs} seeds: {wrong} wrong joins, {links} open links")


def wrong_links(runs: int) -> None:
    """State how many random wrong links are believed, and how long four planted ones are."""
    waited = [_plant(seed) for seed in range(runs)]
    print(
        f"{runs} seeds: four planted links are removed after {np.median(waited):.0f} (most {max(waited)}) "
        "keyframes with contrary links"
    )
    for inliers in (100, 20):
        believed, sent = _random_links(runs, inliers)
        print(f"{runs} seeds: {believed} of {sent} random wrong links of {inliers} inliers believed")


def _random_links(runs: int, inliers: int) -> tuple[int, int]:
    """Return how many random wrong links are believed, and how many there were."""
    believed = sent = 0
    for seed in range(runs):
        world = GeneratedWorld(seed=seed, wrong_inliers=inliers)
        live_map = LiveMap()
        drives = [world.drive(name, circle(2.0, 1.0, phase)) for name, phase in (("a", 0.0), ("b", 2.0))]
        for event in world.play(drives, wrong=0.4):
            live_map.apply(event)
        for a, b, T_a_b in live_map.believed():
            off = inverse(T_a_b) @ inverse(world.seen[a]) @ world.seen[b]
            believed += float(np.linalg.norm(off[:3, 3])) > 0.3
        sent += world.wrong_sent
    return believed, sent


def _plant(seed: int) -> int:
    """Return after how many keyframes with true links four planted ones, which agree, are removed."""
    world = GeneratedWorld(seed=seed, links=0)
    live_map = LiveMap()
    way = circle(1.0, 1.0)
    a, b = world.drive("a", way[:20]), world.drive("b", way[:50])
    for drive_, count in ((a, 20), (b, 50)):
        for number in range(count):
            live_map.apply(world.keyframe(drive_, number))
    rng = np.random.default_rng(seed)
    off = world.seen[0] @ exp_se3(np.r_[rng.uniform(0.5, 2.0, 3), 0.0, 0.4, 0.0]) @ inverse(world.seen[0])
    for k in range(20, 24):
        planted = make_link(k - 20, inverse(world.seen[k]) @ off @ world.seen[k - 20])
        live_map.apply(LinksMeasured(keyframe=k, links=(planted,)))
    for later in range(16):
        k = 24 + later
        links = tuple(world.true_link(k, k - 20 - near) for near in (0, 1))
        outcomes = live_map.apply(LinksMeasured(keyframe=k, links=links))
        if any(isinstance(outcome, LinkRemoved) for outcome in outcomes):
            return later + 1
    return 99


def twins(runs: int) -> None:
    """State what becomes of robots in two rooms that look the same, which the map may know of."""
    for told_m in (0.0, 4.0):
        _twins(runs, told_m)
        _one_building(runs, told_m)


def _one_building(runs: int, told_m: float) -> None:
    """State when two robots that drive the same way through unique rooms are joined."""
    joined, at_m = 0, []
    for seed in range(runs):
        world = GeneratedWorld(seed=seed, links=2)
        drives = [world.drive(name, straight(0.0, 9.0)) for name in ("a", "b")]
        live_map = LiveMap()
        live_map.apply(MapStarted(source="", keyframes=(), equal_rooms_m=told_m))
        for event in world.play(drives):
            for outcome in live_map.apply(event):
                if isinstance(outcome, Joined) and outcome.robot == "b":
                    joined += 1
                    at_m.append(float(world.seen[-1][0, 3]))
    print(
        f"two robots on one way of 9 m, equal rooms of {told_m:g} m stated, {runs} seeds: {joined} joined, "
        f"after {np.median(at_m):.1f} m (most {max(at_m):.1f})"
    )  # fmt: skip


def _twins(runs: int, told_m: float) -> None:
    for what in ("one robot in each room", "and one that drives from one to the other"):
        wrong = ambiguous = ever = 0
        for seed in range(runs):
            world = GeneratedWorld(seed=seed, twin_m=10.0, links=2)
            drives = [world.drive("a", straight(0.0, 3.0)), world.drive("b", straight(10.0, 13.0))]
            if what.startswith("and"):
                drives.insert(1, world.drive("c", straight(0.0, 13.0)))
            live_map = LiveMap()
            live_map.apply(MapStarted(source="", keyframes=(), equal_rooms_m=told_m))
            outcomes = [outcome for event in world.play(drives) for outcome in live_map.apply(event)]
            ever += any(isinstance(outcome, Joined) and outcome.robot == "b" for outcome in outcomes)
            aligned = {alignment.robot: alignment.aligned for alignment in live_map.alignments()}
            wrong += aligned["b"]
            ambiguous += any(isinstance(outcome, Ambiguous) and outcome.robot == "b" for outcome in outcomes)
        print(
            f"two equal rooms, {told_m:g} m stated, {what}, {runs} seeds: {ever} joined at some time, "
            f"{wrong} at the end, {ambiguous} called ambiguous"
        )


def replay() -> None:
    """State the time of a replay of 2,000 keyframes with measured links, and whether it is the same map."""
    world = GeneratedWorld(seed=1)
    drives = [world.drive(f"robot-{i}", circle(8.0, 0.8, 2.0 * i)[:400]) for i in range(5)]
    log, live_map = _make(world, drives)
    begin = time.process_time()
    again = LiveMap()
    for event in log:
        again.apply(event)
    from_empty = time.process_time() - begin
    snapshot = live_map.snapshot()
    begin = time.process_time()
    restored = LiveMap.restore(snapshot)
    from_snapshot = time.process_time() - begin
    same = again.digest() == live_map.digest() == restored.digest()
    print(
        f"replay of {len(world.seen)} keyframes: {from_empty:.1f} s from empty, {from_snapshot:.2f} s from "
        f"a snapshot of {len(snapshot) / 1e6:.1f} MB; {'equal' if same else 'NOT EQUAL'} to the byte"
    )


def growth(keyframes: int) -> None:
    """State the cost of a keyframe in a map that grows, wide and revisiting."""
    for what, way in (
        ("wide", meander(50.0, keyframes // 500 + 2)),
        ("revisiting", circle(3.0, keyframes / 150.0)),
    ):
        world = GeneratedWorld(seed=1)
        drives = [world.drive("a", way[:keyframes])]
        ms: list[float] = []
        _, live_map = _make(world, drives, ms)
        cost = np.array(ms[0::2]) + np.array(ms[1::2])
        early, late = cost[len(cost) * 9 // 100 : len(cost) // 10], cost[len(cost) * 9 // 10 :]
        ratios = [np.percentile(late, q) / np.percentile(early, q) for q in (50, 95)]
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(
            f"{what}, {len(world.seen)} keyframes, {live_map.keyframes} kept: p50 {np.median(late):.1f} ms, "
            f"{ratios[0]:.2f} times that at a tenth of the map; p95 {np.percentile(late, 95):.1f} ms, "
            f"{ratios[1]:.2f} times; {memory:.2f} GiB in all"
        )


def _make(
    world: GeneratedWorld, drives: Sequence[GeneratedDrive], ms: list[float] | None = None
) -> tuple[list[Event], LiveMap]:
    """Return the log of generated drives, with whole optimisations, and the map."""
    live_map = LiveMap()
    log: list[Event] = []
    for event in world.play(list(drives)):
        begin = time.process_time()
        outcomes = live_map.apply(event)
        if ms is not None:
            ms.append(1000.0 * (time.process_time() - begin))
        log.append(event)
        if any(isinstance(outcome, OptimiseWanted) for outcome in outcomes):
            log.append(live_map.optimise())
            live_map.apply(log[-1])
    return log, live_map


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one part and print its figures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live.one_process")
    parser.add_argument("part", choices=("kitchen", "foreign", "wrong", "twins", "replay", "growth"))
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--keyframes", type=int, default=10_000)
    chosen = parser.parse_args(arguments)
    parts: dict[str, Callable[[], None]] = {
        "kitchen": lambda: kitchen(chosen.recordings, chosen.runs),
        "foreign": lambda: foreign(chosen.recordings, chosen.runs),
        "wrong": lambda: wrong_links(chosen.runs),
        "twins": lambda: twins(chosen.runs),
        "replay": replay,
        "growth": lambda: growth(chosen.keyframes),
    }
    print(f"load average {os.getloadavg()[0]:.1f}, {os.cpu_count()} CPUs, times are CPU times")
    parts[chosen.part]()


if __name__ == "__main__":
    main()

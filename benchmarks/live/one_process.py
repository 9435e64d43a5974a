"""Measure the live map in one process, without a platform: accuracy, joins, wrong loop closures, replay,
growth.

Recordings are tracked by the product's `Tracker`; poses are solved in this process, and corrections reach a
robot two frames late.  Ground truth is used for errors only.

Defends the promises that the final live map of three robots in the red kitchen has an error of at most 3.1 cm
and that the replay of its log gives the same map.

    python -m benchmarks live.one_process kitchen --recordings ../shared/data --runs 10
    python -m benchmarks live.one_process foreign --recordings ../shared/data --runs 20
    python -m benchmarks live.one_process wrong | twins | replay | growth
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import percentile, spread
from benchmarks.recorded_drives import Run, drive, red_kitchen, truth_of
from client_sdk.datasets import Dataset, open_dataset
from client_sdk.frontend import FrontEndOptions
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import ate_m
from rse_pf.extensions.experiments.results.map_error import move_frames
from rse_pf.geometry import Array, exp_se3, inverse
from rse_pf.live_map.events import Event, KeyframeAdded, LoopClosuresMeasured, MapStarted
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.outcomes import (
    Added,
    Ambiguous,
    Corrected,
    Joined,
    LoopClosureRejected,
    OptimiseWanted,
    Outcome,
    Unaligned,
)
from rse_pf.slam.keyframe import SentKeyframe, encode_keyframe
from tests.kit.generated_drives import (
    STEP_M,
    GeneratedDrive,
    GeneratedWorld,
    circle,
    make_link,
    straight,
)

# Options with a keyframe every 0.1 m or 6 degrees, as in maps of the red kitchen.
DENSE = FrontEndOptions(is_spread=False, keyframe_m=0.1, keyframe_deg=6.0)
LATE_FRAMES = 2  # frames by which a correction reaches its robot after the keyframe that caused it
# Parts of this benchmark, of which a run measures one.
PARTS = ("kitchen", "foreign", "wrong", "twins", "replay", "growth")
# Frames of the red kitchen that each of three robots drives.
KITCHEN_CUTS = {"a": range(84), "b": range(84, 168), "c": range(168, 250)}
# Recordings of unrelated places, whose robots must not be joined.
FOREIGN = ("redwood_living_room", "nyu_dining_room", "tum_fr1_xyz_start", "7scenes_redkitchen")


@dataclass(slots=True, eq=False)
class Played:
    """A live map at the end of its drives, and the poses that its robots received.

    Attributes:
        live_map: The map.
        ids: The ids of the keyframes of each robot, in the order of sending.
        given: ``T_map_camera`` by robot and frame, as the robot knew it at this frame; frames before the
            robot was joined to the map are missing.
        outcomes: All outcomes of the events, in order.
    """

    live_map: LiveMap
    ids: dict[str, list[int]] = field(default_factory=dict)
    given: dict[str, dict[int, Array]] = field(default_factory=dict)
    outcomes: list[Outcome] = field(default_factory=list)

    def online_cm(self, truth: Mapping[str, Array]) -> float:
        """Return the ATE, cm, of the poses as the robots knew them while they drove."""
        rows = {name: sorted(errors_cm) for name, errors_cm in self.given.items() if errors_cm}
        given = np.array([self.given[name][row] for name in rows for row in rows[name]])
        return 100.0 * ate_m(given, np.concatenate([truth[name][rows[name]] for name in rows]))

    def final_cm(self, runs: Mapping[str, Run], truth: Mapping[str, Array]) -> float:
        """Return the ATE, cm, of all frames with the poses of the keyframes at the end."""
        poses = [
            final_poses(run, np.array([self.live_map.pose(i) for i in self.ids[name]]))
            for name, run in runs.items()
        ]
        return 100.0 * ate_m(np.concatenate(poses), np.concatenate([truth[name] for name in runs]))

    def joined_at(self) -> dict[str, int]:
        """Return for each robot its first frame of which the robot knew the pose in the map."""
        return {name: min(frames) for name, frames in self.given.items() if frames}


def final_poses(run: Run, T_world_keyframe: Array) -> Array:
    """Return the pose ``(n, 4, 4)`` of each frame of *run* after its keyframes moved to ``(k, 4, 4)``."""
    keyframes = run.version.keyframes
    stamps_s = np.array([keyframe.timestamp_s for keyframe in keyframes])
    before = np.array([keyframe.T_world_camera for keyframe in keyframes])
    path = Trajectory(np.array(run.stamps_s), run.T_world_camera)
    return move_frames(path, stamps_s, before, T_world_keyframe).T_world_camera


def meander(length_m: float, rows: int, apart_m: float = 3.0, x: float = 0.0) -> Array:
    """Return positions ``(n, 2)``, metres, `STEP_M` apart, along *rows* parallel lines of *length_m* in turn.

    The lines are *apart_m* metres from each other, so that the path never comes back to a place.
    """
    corners: list[tuple[float, float]] = []
    for row in range(rows):
        ends = (x, x + length_m) if row % 2 == 0 else (x + length_m, x)
        corners += [(ends[0], row * apart_m), (ends[1], row * apart_m)]
    points = np.array(corners)
    along = np.r_[0.0, np.cumsum(np.sqrt((np.diff(points, axis=0) ** 2).sum(axis=1)))]
    at = np.arange(0.0, along[-1], STEP_M)
    return np.column_stack([np.interp(at, along, points[:, 0]), np.interp(at, along, points[:, 1])])


def play(runs: Mapping[str, Run], starts: Mapping[str, int]) -> Played:
    """Run drives of robots into one live map at the same time; *starts* delays each robot by some frames."""
    played = Played(live_map=LiveMap())
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
    """Send a keyframe, measure its loop closures, and return the alignments that robots get from it.

    An alignment is the tick at which a robot gets it, the robot, and its ``T_map_odom``, None if the robot is
    not joined any more.
    """
    keyframe = run.version.keyframes[number]
    event = KeyframeAdded(
        robot=name, segment=0, number=number, data=encode_keyframe(SentKeyframe.from_map(keyframe))
    )  # fmt: skip
    outcomes = played.live_map.apply(event)
    added = next(outcome for outcome in outcomes if isinstance(outcome, Added))
    played.ids[name].append(added.id)
    outcomes = [*outcomes, *played.live_map.apply(played.live_map.measure(added.id))]
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


def _random_links(runs: int, inliers: int) -> tuple[int, int]:
    """Return how many random wrong loop closures are accepted, and how many there were."""
    accepted = sent = 0
    for seed in range(runs):
        world = GeneratedWorld(seed=seed, wrong_inliers=inliers)
        live_map = LiveMap()
        drives = [world.drive(name, circle(2.0, 1.0, phase)) for name, phase in (("a", 0.0), ("b", 2.0))]
        for event in world.play(drives, wrong=0.4):
            live_map.apply(event)
        for a, b, T_a_b in live_map.accepted_loop_closures():
            off = inverse(T_a_b) @ inverse(world.seen[a]) @ world.seen[b]
            accepted += float(np.linalg.norm(off[:3, 3])) > 0.3
        sent += world.wrong_sent
    return accepted, sent


def _plant(seed: int) -> int:
    """Plant four consistent wrong loop closures; return how many keyframes with true ones remove them."""
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
        live_map.apply(LoopClosuresMeasured(keyframe=k, links=(planted,)))
    for later in range(16):
        k = 24 + later
        links = tuple(world.true_link(k, k - 20 - near) for near in (0, 1))
        outcomes = live_map.apply(LoopClosuresMeasured(keyframe=k, links=links))
        if any(isinstance(outcome, LoopClosureRejected) for outcome in outcomes):
            return later + 1
    return 99


def _make(
    world: GeneratedWorld, drives: Sequence[GeneratedDrive], ms: list[float] | None = None
) -> tuple[list[Event], LiveMap]:
    """Apply the events of generated drives to a new live map; return the log of all events, and the map.

    Whenever the map wants an optimisation, it is made at once, and its event is in the log.  The CPU time of
    each event of the drives, milliseconds, is appended to *ms*; that of the optimisations is not.
    """
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


@benchmark(
    Bar("online_cm.mean", at_most=3.35, unit="cm"),
    Bar("wrong_joins", equals=0),
    Bar("equal_to_the_byte", equals=True),
)
def run_benchmark(
    *, part: Annotated[str, "what is measured", PARTS],
    recordings: Path = Path("../shared/data"), runs: int = 10, keyframes: int = 10_000,
) -> dict[str, Any]:  # fmt: skip
    """Run one part; times are CPU times."""
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "kitchen": lambda: kitchen(recordings, runs), "foreign": lambda: foreign(recordings, runs),
        "wrong": lambda: wrong_links(runs), "twins": lambda: twins(runs), "replay": replay,
        "growth": lambda: growth(keyframes),
    }  # fmt: skip
    return parts[part]()


def kitchen(recordings: Path, runs: int) -> dict[str, Any]:
    """Return the ATE, cm, of one robot and of three in the red kitchen.

    ``one_robot`` drives the whole recording once.  The three drive a third each, *runs* times with other
    starting times; ``final_cm`` and ``online_cm`` are statistics (`spread`) over the ``scored`` runs, those
    in which all three were joined.
    """
    dataset = red_kitchen(recordings)
    whole = {"whole": drive(dataset, range(len(dataset)), "whole", DENSE)}
    three = {name: drive(dataset, rows, name, DENSE) for name, rows in KITCHEN_CUTS.items()}
    truth = {name: truth_of(dataset, run.stamps_s) for name, run in (whole | three).items()}
    played = play(whole, {"whole": 0})
    one = {
        "final_cm": played.final_cm(whole, truth), "online_cm": played.online_cm(truth),
        "frame_to_frame_cm": 100.0 * ate_m(whole["whole"].T_world_camera, truth["whole"]),
    }  # fmt: skip
    final, online, last, share = [], [], [], []
    for seed in range(runs):
        at = np.random.default_rng(seed).integers(0, 60, 3)
        starts = dict(zip(three, (at - at.min()).tolist(), strict=True))
        played = play(three, starts)
        joined = played.joined_at()
        if len(joined) < 3:
            say(f"seed {seed}: only {sorted(joined)} joined: not scored")
            continue
        final.append(played.final_cm(three, truth))
        online.append(played.online_cm(truth))
        last.append(max(joined.values()))
        given = sum(map(len, played.given.values()))
        share.append(100.0 * given / sum(len(run.stamps_s) for run in three.values()))
    return {
        "one_robot": one, "n": runs, "scored": len(final), "final_cm": spread(final),
        "online_cm": spread(online), "last_join_at_own_frame": max(last, default=None),
        "given_out_aligned_percent": spread(share),
    }  # fmt: skip


def foreign(recordings: Path, runs: int) -> dict[str, Any]:
    """Return how many robots of four unrelated recordings are joined wrongly, the sum of all *runs*.

    The runs differ in the order and the starting times of the robots.  ``open_links`` is the sum of the loop
    closures that are neither accepted nor rejected at the end.
    """
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
        links += played.live_map.pending_loop_closure_count
    keyframes = {name: len(run.version.keyframes) for name, run in drives.items()}
    return {"n": runs, "keyframes": keyframes, "wrong_joins": wrong, "open_links": links}


def wrong_links(runs: int) -> dict[str, Any]:
    """Return how many random wrong loop closures are accepted, and how long four consistent ones stay."""
    waited = spread(_plant(seed) for seed in range(runs))
    accepted = {
        f"{inliers} inliers": dict(zip(("accepted", "sent"), _random_links(runs, inliers), strict=True))
        for inliers in (100, 20)
    }
    return {"n": runs, "keyframes_until_four_are_removed": waited, "random_wrong_links": accepted}


def twins(runs: int) -> dict[str, Any]:
    """Return how often robots in two rooms that look the same are joined wrongly.

    The rooms are 10 m apart.  `MapStarted.equal_rooms_m` states to the map that rooms of 4 m look the same,
    or (0) that every place is unique.
    """
    return {
        f"{stated_size_m:g} m stated": {
            "one robot in each room": _twins(runs, stated_size_m, drives_across=False),
            "one drives across": _twins(runs, stated_size_m, drives_across=True),
            "unique rooms": _one_building(runs, stated_size_m),
        }
        for stated_size_m in (0.0, 4.0)
    }


def _one_building(runs: int, stated_size_m: float) -> dict[str, Any]:
    """Return after how many metres two robots that drive the same 9 m through unique rooms are joined."""
    at_m = []
    for seed in range(runs):
        world = GeneratedWorld(seed=seed, links=2)
        drives = [world.drive(name, straight(0.0, 9.0)) for name in ("a", "b")]
        live_map = LiveMap()
        live_map.apply(MapStarted(source="", keyframes=(), equal_rooms_m=stated_size_m))
        for event in world.play(drives):
            for outcome in live_map.apply(event):
                if isinstance(outcome, Joined) and outcome.robot == "b":
                    at_m.append(float(world.seen[-1][0, 3]))
    return {"n": runs, "joined": len(at_m), "joined_after_m": spread(at_m)}


def _twins(runs: int, stated_size_m: float, *, drives_across: bool) -> dict[str, int]:
    wrong = ambiguous = ever = 0
    for seed in range(runs):
        world = GeneratedWorld(seed=seed, twin_m=10.0, links=2)
        drives = [world.drive("a", straight(0.0, 3.0)), world.drive("b", straight(10.0, 13.0))]
        if drives_across:
            drives.insert(1, world.drive("c", straight(0.0, 13.0)))
        live_map = LiveMap()
        live_map.apply(MapStarted(source="", keyframes=(), equal_rooms_m=stated_size_m))
        outcomes = [outcome for event in world.play(drives) for outcome in live_map.apply(event)]
        ever += any(isinstance(outcome, Joined) and outcome.robot == "b" for outcome in outcomes)
        aligned = {alignment.robot: alignment.aligned for alignment in live_map.alignments()}
        wrong += aligned["b"]
        ambiguous += any(isinstance(outcome, Ambiguous) and outcome.robot == "b" for outcome in outcomes)
    return {"n": runs, "joined_ever": ever, "joined_at_the_end": wrong, "ambiguous": ambiguous}


def replay() -> dict[str, Any]:
    """Return the CPU seconds of a replay of 2,000 keyframes, and whether it gives the same map to the byte.

    The log, which contains the measured loop closures, is replayed from an empty map and from a snapshot.
    """
    world = GeneratedWorld(seed=1)
    drives = [world.drive(f"robot-{i}", circle(8.0, 0.8, 2.0 * i)[:400]) for i in range(5)]
    log, live_map = _make(world, drives)
    begin = time.process_time()
    again = LiveMap()
    for event in log:
        again.apply(event)
    from_empty_s = time.process_time() - begin
    snapshot = live_map.snapshot()
    begin = time.process_time()
    restored = LiveMap.restore(snapshot)
    return {
        "keyframes": len(world.seen), "from_empty_s": from_empty_s,
        "from_snapshot_s": time.process_time() - begin, "snapshot_mb": len(snapshot) / 1e6,
        "equal_to_the_byte": again.digest() == live_map.digest() == restored.digest(),
    }  # fmt: skip


def growth(keyframes: int) -> dict[str, Any]:
    """Return the CPU time of a keyframe in two maps that grow to *keyframes* keyframes, one drive each.

    The drive of ``wide`` never comes back to a place; the drive of ``revisiting`` goes round a circle of 3 m
    radius again and again.  The time is that of adding a keyframe and its loop closures, without
    optimisations.  ``late_ms`` is the time for the last tenth of the keyframes, milliseconds;
    ``times_a_tenth`` is the ratio of its percentiles to those when the map had a tenth of its keyframes.
    ``kept`` is the number of keyframes in the map at the end; ``peak_gib`` is the peak memory of this process
    until then.
    """
    rows = {}
    for what, way in (
        ("wide", meander(50.0, keyframes // 500 + 2)),
        ("revisiting", circle(3.0, keyframes / 150.0)),
    ):
        world = GeneratedWorld(seed=1)
        ms: list[float] = []
        _, live_map = _make(world, [world.drive("a", way[:keyframes])], ms)
        cost = np.array(ms[0::2]) + np.array(ms[1::2])
        early, late = cost[len(cost) * 9 // 100 : len(cost) // 10], cost[len(cost) * 9 // 10 :]
        rows[what] = {
            "keyframes": len(world.seen), "kept": live_map.keyframes, "late_ms": spread(late),
            "times_a_tenth": {f"p{q}": percentile(late, q) / percentile(early, q) for q in (50, 95)},
            "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        }  # fmt: skip
    return rows

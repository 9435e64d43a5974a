"""Robots with one lens in a live map: overlap with metric segments gives the scale of their segments."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, exp_se3, inverse, pose_difference, scaled
from rse_pf.live_map.events import (
    Event,
    LoopClosuresMeasured,
    MapStarted,
    MeasuredLoopClosure,
    decode_events,
    encode_events,
    matrix_bytes,
    matrix_of,
)
from rse_pf.live_map.graph_rows import UP_TO_SCALE
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.measure import measure_loop_closures
from rse_pf.live_map.outcomes import Corrected, Joined
from rse_pf.live_map.pairwise_consistency import relative_pose_between_components, relative_scale
from rse_pf.slam.consistency import EdgeArrays, OdometryNoise, are_pairwise_consistent
from rse_pf.slam.keyframe import KeyframeFeatures, make_features, make_scaleless_features
from rse_pf.slam.smoother import ScaleTerms, smooth
from tests.kit.generated_drives import GeneratedDrive, GeneratedWorld, circle, make_link, straight
from tests.kit.hostile_robot import play, without
from tests.kit.synthetic_maps import make_world

HOSTILE = "x"
WAY = 1.0, 1.1
Tamper = Callable[[GeneratedWorld, int, MeasuredLoopClosure], MeasuredLoopClosure]


class Run:
    """Robots in one live map, the alignments that it reported, and its errors."""

    def __init__(self, seed: int, units_m: dict[str, float | None], wrong: float = 0.0) -> None:
        self.world, self.map = GeneratedWorld(seed=seed), LiveMap()
        self.log: list[Event] = []
        self.told: list[Corrected | Joined] = []
        self.drives = [
            self.world.drive(name, circle(*WAY, phase=2.0 * place), unit_m=unit_m)
            for place, (name, unit_m) in enumerate(units_m.items())
        ]
        self.wrong = wrong

    def play(self, drives: list[GeneratedDrive] | None = None, tamper: Tamper | None = None) -> Run:
        for event in self.world.play(self.drives if drives is None else drives, self.wrong):
            if tamper is not None and isinstance(event, LoopClosuresMeasured):
                links = tuple(tamper(self.world, event.keyframe, link) for link in event.links)
                event = msgspec.structs.replace(event, links=links)
            self.log.append(event)
            self.told += [each for each in self.map.apply(event) if isinstance(each, Corrected | Joined)]
        return self

    def scale_of(self, robot: str) -> float:
        return next(each.scale for each in self.map._graph.segments if each.robot == robot)

    def ids(self, robot: str) -> list[int]:
        return [i for i, (name, _) in enumerate(self.world.owners) if name == robot]

    def error_cm(self, robot: str) -> float:
        """Return the root of the mean squared error of a robot's keyframes, relative to keyframe 0."""
        ids = self.ids(robot)
        off = [
            (inverse(self.map.pose(0)) @ self.map.pose(i))[:3, 3]
            - (inverse(self.world.seen[0]) @ self.world.seen[i])[:3, 3]
            for i in ids
        ]
        return 100.0 * float(np.sqrt((np.array(off) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize(("seed", "unit_m"), [(0, 0.37), pytest.param(1, 2.9, marks=pytest.mark.slow)])
def test_a_robot_without_metric_scale_gets_it_from_a_metric_one(seed: int, unit_m: float) -> None:
    run = Run(seed, {"a": None, "b": unit_m, "c": None}, wrong=0.3).play()
    [lens] = [each for each in run.map.alignments() if each.robot == "b"]

    assert next(each.robot for each in run.told if isinstance(each, Joined)) == "a"
    assert abs(run.scale_of("b") / unit_m - 1.0) < 0.01
    assert lens.aligned
    assert lens.scale is not None
    assert lens.T_map_odom is not None
    newest = run.ids("b")[-1]
    T_map_camera = lens.T_map_odom @ scaled(run.drives[1].T_odom_camera[-1], lens.scale)
    assert pose_difference(T_map_camera, run.map.pose(newest))[0] < 0.02
    assert max(run.error_cm(robot) for robot in "abc") < 3.0
    assert all(each.scale is None for each in run.told if isinstance(each, Corrected) and each.robot != "b")


def test_the_first_robot_of_a_map_may_have_no_metric_scale() -> None:
    run = Run(3, {"a": 0.5, "b": 3.0})
    run.play()
    before = run.map.alignments()
    bridges = [pair for pair in run.map._graph.accepted_edges_by_segments() if pair[0] != pair[1]]

    assert bridges, "the two are one component before"
    assert [(each.aligned, each.reason) for each in before] == [(False, UP_TO_SCALE)] * 2
    assert abs(run.scale_of("a") / run.scale_of("b") / (0.5 / 3.0) - 1.0) < 0.01
    assert not run.map.to_version().keyframes

    run.play([run.world.drive("c", circle(*WAY, phase=4.0))])

    assert all(each.aligned for each in run.map.alignments())
    assert abs(run.scale_of("a") / 0.5 - 1.0) < 0.015
    assert abs(run.scale_of("b") / 3.0 - 1.0) < 0.015


@pytest.fixture(scope="module")
def joined() -> Run:
    """A metric robot, and one without metric scale that joined it; tests read it and play nothing more."""
    return Run(5, {"a": None, "b": 0.4}).play()


def test_a_replay_and_a_snapshot_with_scales_are_equal_to_the_byte(joined: Run) -> None:
    again, half = LiveMap(), LiveMap()
    log = decode_events(encode_events(joined.log))
    for event in log:
        again.apply(event)
    for event in log[: len(log) // 2]:
        half.apply(event)
    restored = LiveMap.restore(half.snapshot())
    for event in log[len(log) // 2 :]:
        restored.apply(event)

    assert again.snapshot() == joined.map.snapshot()
    assert restored.digest() == joined.map.digest()


def test_a_version_is_in_metres(joined: Run) -> None:
    run = joined
    version = run.map.to_version()
    own = [each for each in version.keyframes if each.robot == "b"]

    assert own
    for each in own:
        np.testing.assert_allclose(each.T_world_camera, run.map.pose(each.id))
        assert 0.9 < each.points_camera[:, 2].min() < each.points_camera[:, 2].max() < 4.1
    for edge in version.edges:
        step = inverse(run.world.seen[edge.a]) @ run.world.seen[edge.b]
        assert pose_difference(edge.T_a_b, step)[0] < 0.1


def test_loop_closures_whose_scales_contradict_each_other_join_nothing() -> None:
    rng = np.random.default_rng(0)

    def tamper(world: GeneratedWorld, keyframe: int, link: MeasuredLoopClosure) -> MeasuredLoopClosure:
        if link.scale is None:
            return link
        return world.in_units(keyframe, _in_metres(world, keyframe, link), math.exp(rng.uniform(-2.0, 2.0)))

    run = Run(6, {"a": None, "b": 0.4}).play(tamper=tamper)

    assert [each.aligned for each in run.map.alignments()] == [True, False]


def test_loop_closures_within_the_map_whose_scale_is_wrong_are_not_accepted() -> None:
    run = Run(7, {"a": None, "b": 0.4}).play()
    newest = run.ids("b")[-1]
    near = min(run.ids("a"), key=lambda i: pose_difference(run.world.seen[i], run.world.seen[newest])[0])
    links = [
        run.world.in_units(newest, _in_metres(run.world, newest, run.world.true_link(newest, near)), ratio)
        for ratio in (1.0, 1.4)
    ]
    believed = []
    for link in links:
        copy = LiveMap.restore(run.map.snapshot())
        before = copy.loop_closure_count
        copy.apply(LoopClosuresMeasured(keyframe=newest, links=(link,)))
        believed.append(copy.loop_closure_count - before)

    assert believed == [1, 0]


@pytest.mark.parametrize(
    "lie", [pytest.param(0.5, marks=pytest.mark.slow), pytest.param(0.9, marks=pytest.mark.slow), 1.1]
)
def test_a_false_scale_moves_no_other_robot(lie: float) -> None:
    """The hostile robot's depths are *lie* times as deep as its odometry says."""

    def tamper(world: GeneratedWorld, keyframe: int, link: MeasuredLoopClosure) -> MeasuredLoopClosure:
        if link.scale is None:
            return link
        off = math.log(lie) if world.owners[link.other][0] == HOSTILE else -math.log(lie)
        return msgspec.structs.replace(link, scale=(link.scale[0] + off, link.scale[1]))

    attacked = Run(8, {"a": None, "b": None, HOSTILE: 0.7}).play(tamper=tamper)
    honest = Run(8, {"a": None, "b": None, HOSTILE: 0.7}).play()
    alone = play(without(attacked.log, HOSTILE))

    if lie == 0.5:  # the robot is not joined, so the map is the one without it
        kept = [i for i, (name, _) in enumerate(attacked.world.owners) if name != HOSTILE]
        for number, i in enumerate(kept):
            assert pose_difference(attacked.map.pose(i), alone.live_map.pose(number))[0] < 1e-3
    else:
        for run in (attacked, honest):
            run.map.apply(run.map.optimise())
        assert max(attacked.error_cm(robot) - honest.error_cm(robot) for robot in "ab") <= 0.1


def test_a_segment_does_not_change_whether_it_has_metres() -> None:
    run = Run(9, {"a": None, "b": 0.4})
    metric, lens = run.drives
    run.map.apply(run.world.keyframe(lens, 0))
    wrong = msgspec.structs.replace(run.world.keyframe(metric, 1), robot="b")

    with pytest.raises(BadRequest, match="with and without metres"):
        run.map.check_keyframe(wrong)


def test_a_pose_that_is_far_in_a_small_unit_is_refused() -> None:
    run = Run(10, {"b": 0.01})
    far = run.drives[0].T_odom_camera.copy()
    far[0, 0, 3] = 9e8
    near = run.world.keyframe(run.drives[0], 0)
    event = run.world.keyframe(replace(run.drives[0], T_odom_camera=far), 0)

    assert run.map.check_keyframe(near) == "new"
    with pytest.raises(BadRequest, match="from the odometry's start"):
        run.map.check_keyframe(event)


def test_rooms_of_a_stated_size_are_measured_in_metres() -> None:
    world, live_map = GeneratedWorld(seed=11, links=2), LiveMap()
    live_map.apply(MapStarted(source="", keyframes=(), equal_rooms_m=4.0))
    drives = [world.drive("a", straight(0.0, 9.0)), world.drive("b", straight(0.0, 9.0), unit_m=0.1)]
    at_m = [
        float(world.seen[-1][0, 3])
        for event in world.play(drives) for each in live_map.apply(event)
        if isinstance(each, Joined) and each.robot == "b"
    ]  # fmt: skip

    assert at_m
    assert at_m[0] > 4.0


@pytest.mark.parametrize("units_m", [(0.5, 3.0), (None, 3.0), (0.5, None)])
def test_a_loop_closure_gives_one_pose_whichever_of_its_ends_was_measured(
    units_m: tuple[float | None, float | None],
) -> None:
    world, live_map = GeneratedWorld(seed=12), LiveMap()
    for name, phase, unit_m in zip("ab", (0.0, 0.3), units_m, strict=True):
        live_map.apply(world.keyframe(world.drive(name, circle(1.0, 0.5, phase), unit_m=unit_m), 3))
    graph = live_map._graph
    live_map.apply(
        LoopClosuresMeasured(keyframe=1, links=(world.in_units(1, make_link(0, world.step(1, 0))),))
    )
    live_map.apply(
        LoopClosuresMeasured(keyframe=0, links=(world.in_units(0, make_link(1, world.step(0, 1))),))
    )

    for stay in (0, 1) if None not in units_m else (units_m.index(None),):
        moving, unit_m = 1 - stay, units_m[stay] or 1.0
        for number, link in graph.edges.items():
            assert link.scale is not None
            true = math.log((units_m[1 - link.a] or 1.0) / (units_m[link.a] or 1.0))
            link.scale = true, link.scale[1]
            log_scale, variance = relative_scale(graph, number, stay)
            ends = relative_pose_between_components(graph, number, stay, log_scale)
            length = graph.segments[stay].scale / unit_m
            assert variance > 0.0
            assert (ends.a, ends.b) == (stay, moving)
            np.testing.assert_allclose(ends.T_a_b, scaled(world.step(stay, moving), length), atol=1e-9)


def test_loop_closures_of_one_place_whose_scales_differ_are_not_consistent() -> None:
    T = np.array([np.eye(4)] * 2)

    def ends(log_scale: float) -> EdgeArrays:
        return EdgeArrays(
            a=np.array([0]), b=np.array([1]), T_a_b=np.eye(4)[None], variances=np.full((1, 6), 1e-4),
            scales=np.array([[log_scale, 0.03**2]]),
        )  # fmt: skip

    def agree(other: float) -> bool:
        return bool(are_pairwise_consistent(T, ends(0.7), ends(other), np.zeros(1), OdometryNoise())[0])

    assert agree(0.75)
    assert not agree(0.9)


# --- Scales measured from features ---

WORLD, TRUTH = make_world(3, points=4000).walk("r", np.array([0.0, 0.02, 0.04, 0.5]), seed=1)
CAMERA = WORLD.keyframes[0].camera


def features(number: int, unit_m: float | None) -> KeyframeFeatures:
    each = WORLD.keyframes[number]
    depths = each.points_camera[:, 2]
    if unit_m is None:
        return make_features(each.pixels, depths, each.descriptors)
    return make_scaleless_features(each.pixels, depths / unit_m, each.descriptors)


@pytest.mark.parametrize("units_m", [(None, 0.01), (0.3, None), (5.0, 0.2), (1e-3, 1e3)])
def test_a_loop_closure_measures_pose_and_scale(units_m: tuple[float | None, float | None]) -> None:
    [link] = measure_loop_closures(
        (0, features(0, units_m[0]), CAMERA), [(1, features(1, units_m[1]), CAMERA)]
    ).links
    here, there = units_m[0] or 1.0, units_m[1] or 1.0
    length = 1.0 if None in units_m else here
    T = scaled(matrix_of(link.T_keyframe_other, 4, 4), length)
    information = matrix_of(link.information, 6, 6)

    metres, degrees = pose_difference(T, inverse(TRUTH[0]) @ TRUTH[1])
    assert metres < 0.03
    assert degrees < 0.5
    assert link.scale is not None
    log_ratio, variance = link.scale
    assert abs(log_ratio - math.log(there / here)) < 3.0 * math.sqrt(variance) < 0.15
    deviation = length * math.sqrt(np.linalg.inv(information)[0, 0])
    assert 0.015 < deviation < 0.06


# --- Scales estimated together with poses ---


def test_a_scale_is_fitted_with_the_poses_of_a_chain() -> None:
    rng = np.random.default_rng(2)
    true = [np.eye(4)]
    for _ in range(12):
        true.append(true[-1] @ exp_se3(np.r_[rng.normal(size=3), 0.3 * rng.normal(size=3)]))
    T_true = np.array(true)
    steps = scaled(inverse(T_true[:-1]) @ T_true[1:], 1.0 / 1.7)
    ends = inverse(T_true[:1]) @ T_true[12:]
    a, b = np.r_[np.arange(12), 0], np.r_[np.arange(1, 13), 12]
    # The held ones come last: poses 0 and 12.
    order = np.r_[np.arange(1, 12), 0, 12]
    row_of = np.argsort(order)
    start = T_true[order].copy()
    start[:11] = start[:11] @ exp_se3(0.05 * rng.normal(size=(11, 6)))

    found = smooth(
        start, 11, row_of[a], row_of[b], np.concatenate([steps, ends]), np.tile(np.eye(6) * 1e4, (13, 1, 1)),
        np.arange(13) == 12, cauchy=3.0, wanted=np.array([0]),
        scales=ScaleTerms(
            count=1, of_edge=np.r_[np.zeros(12, dtype=np.int64), -1],
            plus=np.full(13, -1), minus=np.full(13, -1), difference=np.zeros(13), information=np.zeros(13),
        ),
    )  # fmt: skip

    assert abs(float(found.log_scales[0]) - math.log(1.7)) < 0.01
    for one, other in zip(found.T, T_true[order], strict=True):
        assert pose_difference(one, other)[0] < 0.03
    assert found.covariances.shape == (1, 6, 6)


def _in_metres(world: GeneratedWorld, keyframe: int, link: MeasuredLoopClosure) -> MeasuredLoopClosure:
    """Return the loop closure in metres that `GeneratedWorld.in_units` would convert to *link*."""
    here, there = world.units_m[keyframe], world.units_m[link.other]
    length: float = here if here is not None and there is not None else 1.0
    T: Array = scaled(matrix_of(link.T_keyframe_other, 4, 4), length)
    per = np.array([1.0 / length] * 3 + [1.0] * 3)
    information = per[:, None] * matrix_of(link.information, 6, 6) * per
    return msgspec.structs.replace(
        link, T_keyframe_other=matrix_bytes(T), information=matrix_bytes(information), scale=None
    )  # fmt: skip

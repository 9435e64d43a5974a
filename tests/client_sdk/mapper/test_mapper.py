"""From frames to a trajectory and a map, with and without depth, and when nobody answers."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame, FrontEndOptions, PoseQuery, TrackedFrame
from client_sdk.mapper import Mapper
from client_sdk.monocular.scale import OdometryScale
from client_sdk.robot import Robot, connect
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.trajectory import Trajectory, read_trajectory
from client_sdk.trajectory_error import accuracy
from rse_pf.errors import Busy, UsageError
from rse_pf.geometry import exp_se3
from rse_pf.pnp import solve_pnp
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import STEP_M, frame_at, tracked

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")


def drive(mapper: Mapper, rows: range, *, depth: bool, odometry: bool = False) -> list[TrackedFrame]:
    async def all_frames() -> list[TrackedFrame]:
        return [
            await mapper.track(
                frame_at(row, depth=depth),
                position_m=np.array([STEP_M * row, 0.0, 0.0]) if odometry else None,
            )
            for row in rows
        ]

    return asyncio.run(all_frames())


def test_frames_with_depth_give_metric_poses_and_a_dense_map() -> None:
    mapper = Mapper(ask=solve)

    done = drive(mapper, range(4), depth=True)

    assert [each.status for each in done] == ["first", "tracked", "tracked", "tracked"]
    assert mapper.trajectory.positions[:, 0] == pytest.approx(STEP_M * np.arange(4), abs=0.01)
    assert len(mapper.map) > 2000
    assert mapper.scale == "metric, by depth"
    assert done[3].covariance is not None
    assert (done[3].source, done[3].round_trip_ms) == ("cloud", 3.0)


def test_a_frame_without_an_answer_is_lost_with_the_reason_and_the_next_frame_is_tracked() -> None:
    async def refuses_once(query: PoseQuery) -> PoseAnswer:
        if query.timestamp_s == pytest.approx(0.1):
            raise Busy("the server is busy")
        return await solve(query)

    mapper = Mapper(ask=refuses_once)

    done = drive(mapper, range(3), depth=True)

    assert [each.status for each in done] == ["first", "lost", "tracked"]
    assert done[1].reason == "busy: the server is busy"
    assert mapper.lost_frames == 1
    assert mapper.report()["lost_because"] == {"busy: the server is busy": 1}


async def test_a_cancelled_frame_leaves_the_mapper_usable() -> None:
    asked, never = asyncio.Event(), asyncio.Event()

    async def ask(query: PoseQuery) -> PoseAnswer:
        if not asked.is_set():
            asked.set()
            await never.wait()
        return await solve(query)

    mapper = Mapper(ask=ask)
    await mapper.track(frame_at(0, depth=True))
    task = asyncio.create_task(mapper.track(frame_at(1, depth=True)))
    await asyncio.wait_for(asked.wait(), 10)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task

    assert (await mapper.track(frame_at(2, depth=True))).status == "tracked"


def zoomed(frame: Frame) -> Frame:
    return replace(frame, camera=msgspec.structs.replace(frame.camera, fx=2.0 * frame.camera.fx))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda f: replace(f, rgb=(f.rgb / 255).astype(np.float32)), "rgb holds float32"),
        (lambda f: replace(f, depth_m=(f.depth_m * 1000).astype(np.uint16)), "depth_m uint16"),
        (lambda f: replace(f, depth_m=f.depth_m * 1000), "median depth"),
        (lambda f: replace(f, depth_m=f.depth_m * 100), "median depth"),
        (lambda f: replace(f, rgb=f.rgb[:-1]), "do not fit a camera"),
        (lambda f: replace(f, timestamp_s=float("nan")), "timestamp_s = nan"),
        (lambda f: replace(f, timestamp_s=1.7e18 + f.timestamp_s), "timestamp_s = 1.7e"),
        (lambda f: replace(f, timestamp_s=7.0), "not later than the one before, of 7.000000 s"),
        (lambda f: replace(f, timestamp_s=-f.timestamp_s), "not later than the one before"),
        (zoomed, "of another camera"),
    ],
)
def test_an_invalid_frame_is_refused_with_a_hint_and_the_drive_continues(
    change: Callable[[Frame], Frame], expected: str
) -> None:
    mapper = Mapper(ask=solve)
    frames = [replace(frame_at(row, depth=True), timestamp_s=1.0 + row) for row in range(4)]
    is_alone = "median" in expected

    with pytest.raises(UsageError, match=expected) as refused:
        tracked(mapper, [*([] if is_alone else frames[:2]), *map(change, frames[2:])])

    assert refused.value.hint
    later = [replace(frame, timestamp_s=10.0 + frame.timestamp_s) for frame in frames]
    assert not any(each.lost for each in tracked(mapper, later))


def test_frames_without_depth_give_a_map_up_to_scale_and_say_so() -> None:
    mapper = Mapper(ask=solve)

    done = drive(mapper, range(10), depth=False)

    assert (done[0].status, done[0].reason) == ("starting", "the first frame")
    assert [each.status for each in done[4:]] == ["tracked"] * 6
    assert {each.scale for each in done} == {"up to scale"}
    report = mapper.report()
    assert (report["scale"], report["unit"], report["lost_frames"]) == ("up to scale", "unit of the map", 0)
    x = mapper.trajectory.positions[:, 0]
    assert len(x) == 10  # the frames before the start got their poses later
    assert x / x[-1] == pytest.approx(np.arange(10) / 9, abs=0.02)
    assert len(mapper.map) > 300


def test_odometry_makes_a_camera_without_depth_metric() -> None:
    mapper = Mapper(ask=solve, scale=OdometryScale(first_m=0.2))

    done = drive(mapper, range(9), depth=False, odometry=True)

    metric = [each.scale == "metric" for each in done]
    assert metric == sorted(metric)
    assert done[metric.index(True)].corrected
    assert mapper.scale == "metric, by the first 0.2 m of odometry"
    assert mapper.trajectory.positions[:, 0] == pytest.approx(STEP_M * np.arange(9), abs=0.01)
    last = done[-1].T_world_camera
    assert last is not None
    assert last[:3, 3] == pytest.approx(mapper.trajectory.positions[-1], abs=1e-9)
    depths = mapper.map.points()[0][:, 2]
    assert np.median(np.abs(depths[:, None] - [2.0, 4 / 3, 1.0]).min(axis=1)) < 0.1


def test_a_lost_camera_without_depth_is_found_again_where_it_was() -> None:
    mapper = Mapper(ask=solve)
    drive(mapper, range(6), depth=False)
    blank = frame_at(8, depth=False)
    blank = replace(blank, rgb=np.full_like(blank.rgb, 128))

    lost, found = tracked(mapper, [blank, replace(frame_at(5, depth=False), timestamp_s=9.0)])

    assert (lost.status, lost.T_world_camera) == ("lost", None)
    assert "matches" in lost.reason
    assert found.status == "tracked"
    assert mapper.lost_frames == 1


@pytest.mark.slow
def test_the_kitchen_without_its_depth_is_mapped_within_8_cm(recordings: Path) -> None:
    dataset = open_dataset(recordings / "7scenes_redkitchen")
    assert dataset.truth is not None
    truth = dataset.truth
    mapper = Mapper(ask=solve, depth=False, scale=OdometryScale(truth.timestamps_s, truth.positions))

    tracked(mapper, (replace(frame, depth_m=np.zeros_like(frame.depth_m)) for frame in dataset))

    path: Trajectory = mapper.trajectory
    assert mapper.scale.startswith("metric")
    assert mapper.lost_frames <= 0.05 * len(dataset)
    assert len(path) >= 0.95 * len(dataset)
    assert accuracy(path, truth).ate_m <= 0.08


def test_the_mapper_of_a_robot_asks_it_and_keeps_commands_of_its_codec_small(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[int, object]] = []

    async def answered(
        self: Robot, points: Any, pixels: Any, camera: Any, options: Any, **more: Any
    ) -> PoseAnswer:
        asked.append((len(points), more["deadline_s"]))
        solution = solve_pnp(points, pixels, camera, options)
        return PoseAnswer(
            solution=solution, source="cloud", server="s", round_trip_ms=1.0, queue_ms=0.0, compute_ms=0.0
        )

    monkeypatch.setattr(Robot, "solve_pnp", answered)
    mapper = connect("ws://127.0.0.1:1/ws", codec="json").mapper(deadline_s=0.5)

    assert [each.status for each in drive(mapper, range(2), depth=True)] == ["first", "tracked"]
    assert asked[0][0] <= FrontEndOptions().sent_with("json").max_matches
    assert asked[0][1] == 0.5


@pytest.mark.parametrize("depth", [True, False])
def test_a_frame_that_is_cancelled_while_it_is_matched_leaves_no_query_open(
    depth: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mapper = Mapper(ask=solve)
    drive(mapper, range(9), depth=depth)
    tracker = mapper._tracker
    assert tracker is not None
    prepare = tracker.prepare
    begun, goes_on, ended = threading.Event(), threading.Event(), threading.Event()

    def slow(frame: Frame) -> PoseQuery | TrackedFrame:
        begun.set()
        assert goes_on.wait(10.0)
        step = prepare(frame)
        ended.set()
        return step

    async def cancel() -> None:
        tracking = asyncio.ensure_future(mapper.track(frame_at(9, depth=depth)))
        await asyncio.to_thread(begun.wait, 10.0)
        tracking.cancel()
        asyncio.get_running_loop().call_soon(goes_on.set)
        with pytest.raises(asyncio.CancelledError):
            await tracking
        assert await asyncio.to_thread(ended.wait, 10.0)

    monkeypatch.setattr(tracker, "prepare", slow)
    asyncio.run(cancel())
    monkeypatch.undo()

    assert mapper.save(tmp_path)["frames"] == 10
    assert [done.status for done in drive(mapper, range(10, 11), depth=depth)] == ["tracked"]


def test_all_keyframes_without_depth_are_adjusted_when_the_map_is_saved(tmp_path: Path) -> None:
    mapper = Mapper(ask=solve, scale=OdometryScale(first_m=0.2))
    drive(mapper, range(9), depth=False, odometry=True)
    assert isinstance(mapper._tracker, MonocularTracker)
    landmarks = mapper._tracker._segments[0].map
    before = landmarks.points.copy()
    landmarks.points += np.random.default_rng(1).normal(0.0, 0.02, before.shape)

    mapper.save(tmp_path)

    off_m = np.linalg.norm(landmarks.points - before, axis=1)[landmarks.is_alive]
    assert np.median(off_m) < 0.01
    assert mapper.trajectory.positions[:, 0] == pytest.approx(STEP_M * np.arange(9), abs=0.01)


def test_a_rig_gives_the_poses_of_its_body_beside_those_of_its_camera(tmp_path):
    T_body_camera = exp_se3(np.array([0.1, -0.2, 0.3, 0.4, -1.0, 0.7]))
    mapper = Mapper(ask=solve)

    frames = (frame_at(row, depth=True) for row in range(3))
    done = tracked(mapper, (replace(frame, T_body_camera=T_body_camera) for frame in frames))
    report = mapper.save(tmp_path)

    np.testing.assert_allclose(report["T_body_camera"], T_body_camera)
    cameras, bodies = (read_trajectory(tmp_path / f"trajectory{end}.txt") for end in ("", "-body"))
    for row, each in enumerate(done):
        assert each.T_world_body is not None
        np.testing.assert_allclose(each.T_world_body @ T_body_camera, each.T_world_camera, atol=1e-12)
        np.testing.assert_allclose(bodies.T_world_camera[row], each.T_world_body, atol=1e-8)
    np.testing.assert_allclose(bodies.timestamps_s, cameras.timestamps_s)
    assert "T_world_body, metres" in (tmp_path / "trajectory-body.txt").read_text()

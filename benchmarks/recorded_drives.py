"""Maps from a recording, as robots would upload them, and the error of a merged map.

Poses are solved in this process, without a platform; ground truth is used for errors only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.datasets import Dataset, open_dataset
from client_sdk.frontend import Frame, FrontEndOptions, PoseQuery, TrackedFrame, extract
from client_sdk.point_map import MapOptions, PointMap
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.tracker import Tracker
from rse_pf.errors import PnpError
from rse_pf.geometry import Array
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.pnp import PnpOptions, PnpSolution, refine_with_depth, solve_pnp

# Folder of the recording 7-Scenes RedKitchen.
RED_KITCHEN = "7scenes_redkitchen"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """One robot's drive: its map, each frame's pose in the robot's own world, and its keyframe."""

    version: MapVersion
    stamps_s: tuple[float, ...]
    T_world_camera: Array
    keyframe_of_frame: npt.NDArray[np.int64]
    """Row of the last keyframe at or before each frame."""
    rows: tuple[int, ...]


def red_kitchen(recordings: Path) -> Dataset:
    """Return the red-kitchen recording, 250 frames at 10 Hz."""
    return open_dataset(recordings / RED_KITCHEN)


def drive(dataset: Dataset, rows: Sequence[int], robot: str, options: FrontEndOptions | None = None) -> Run:
    """Track *rows* of *dataset* by visual odometry from the origin; return the robot's map and poses."""
    options = options or FrontEndOptions()
    tracker = Tracker(options)
    keyframes: list[Keyframe] = []
    poses, stamps, owner, views = [], [], [], []
    for row in rows:
        frame = dataset.read(row)
        step = track(tracker, frame)
        if step.T_world_camera is None:
            continue
        if step.keyframe:
            features = extract(frame, options)
            keyframes.append(
                Keyframe(
                    id=len(keyframes), robot=robot, timestamp_s=frame.timestamp_s,
                    T_world_camera=step.T_world_camera, camera=frame.camera,
                    pixels=features.pixels.astype(np.float32), descriptors=features.descriptors,
                    points_camera=features.points_camera.astype(np.float32),
                )
            )  # fmt: skip
        poses.append(step.T_world_camera)
        stamps.append(frame.timestamp_s)
        owner.append(len(keyframes) - 1)
        views.append(row)
    return Run(
        version=MapVersion(keyframes=tuple(keyframes), provenance={"robot": robot}),
        stamps_s=tuple(stamps),
        T_world_camera=np.array(poses),
        keyframe_of_frame=np.array(owner),
        rows=tuple(views),
    )


def keyframe_of(dataset: Dataset, row: int, T_world_camera: Array, number: int) -> Keyframe:
    """Return frame *row* as a keyframe at a given pose."""
    frame = dataset.read(row)
    features = extract(frame, FrontEndOptions())
    return Keyframe(
        id=number, robot="map", timestamp_s=frame.timestamp_s, T_world_camera=T_world_camera,
        camera=frame.camera, pixels=features.pixels.astype(np.float32), descriptors=features.descriptors,
        points_camera=features.points_camera.astype(np.float32),
    )  # fmt: skip


def truth_of(dataset: Dataset, stamps_s: Sequence[float]) -> Array:
    """Return the ``(n, 4, 4)`` true poses nearest to *stamps_s*."""
    assert dataset.truth is not None
    known = np.asarray(dataset.truth.timestamps_s)
    nearest = [int(np.argmin(np.abs(known - stamp))) for stamp in stamps_s]
    return np.asarray(dataset.truth.T_world_camera)[nearest]


def solved(query: PoseQuery) -> PnpSolution:
    """Return the pose of a query as the platform solves it; raises PnpError without a pose."""
    options = PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations)
    matches = query.correspondences
    solution = solve_pnp(matches.points_world, matches.pixels, query.camera, options)
    if not matches.depths_m.any():
        return solution
    return refine_with_depth(solution, matches.points_world, matches.pixels, matches.depths_m, query.camera)


async def answer(query: PoseQuery) -> PoseAnswer:
    """Answer a pose query of a mapper as the platform does; raises PnpError without a pose."""
    return PoseAnswer(
        solution=solved(query), source="robot", server="", round_trip_ms=0.0, queue_ms=0.0, compute_ms=0.0
    )


def judged_answer(query: PoseQuery) -> tuple[Array | None, int, bool]:
    """Solve a pose query as the platform does: return ``T_camera_world``, inlier count, whether it is weak.

    Without a pose the result is None, 0 and False.
    """
    try:
        solution = solved(query)
    except PnpError:
        return None, 0, False
    return solution.T_camera_world, len(solution.inliers), solution.verdict == "weak"


def track(tracker: Tracker | MonocularTracker, frame: Frame) -> TrackedFrame:
    """Return the tracker's result for a frame, with poses solved as the service does."""
    step = tracker.prepare(frame)
    while isinstance(step, PoseQuery):
        pose, inliers, is_weak = judged_answer(step)
        step = tracker.accept(step, pose, inliers, is_weak=is_weak)
    return step


def cloud_of(dataset: Dataset, rows: Sequence[int], T_world_camera: Array, voxel_m: float = 0.01) -> PointMap:
    """Return the point cloud of the frames *rows* at the poses *T_world_camera*, with voxels of *voxel_m*."""
    cloud = PointMap(MapOptions(voxel_m=voxel_m))
    for row, T in zip(rows, T_world_camera, strict=True):
        cloud.add(dataset.read(row), T)
    return cloud

"""Robots that drive parts of one recording, and the errors of their merged map."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client_sdk.datasets import Dataset, open_dataset
from rse_pf.experiments.results.trajectory_error import ate_m
from rse_pf.geometry import Array, exp_se3, inverse, pose_difference
from rse_pf.service import Report
from rse_pf.services.mapping.localise import locate
from rse_pf.services.mapping.place import MapIndex
from rse_pf.slam.consistency import LoopClosure
from rse_pf.slam.map_merge import Atlas, LoopProposals, MergedMap, MergeOptions, propose_links
from rse_pf.slam.relative_pose import View
from tests.recorded_drives import RED_KITCHEN, Run, cloud_of, drive, frame_poses, keyframe_of, truth_of

THREE_ROBOTS = ((0, 84), (84, 168), (168, 250))
LOCALISE_INLIERS = 30


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Robots:
    """Some robots' drives through one recording, and the true poses of all their frames."""

    dataset: Dataset
    runs: tuple[Run, ...]
    truth: Array

    def ate_m(self, T_world_camera: Array) -> float:
        """Return the absolute trajectory error of all frames together."""
        return ate_m(T_world_camera, self.truth)


@functools.lru_cache(maxsize=3)
def robots_of(
    recordings: Path,
    cuts: tuple[tuple[int, int], ...] = THREE_ROBOTS,
    name: str = RED_KITCHEN,
) -> Robots:
    """Return the robots that drive the *cuts* (rows from, to) of a recording, each from its own origin."""
    dataset = open_dataset(recordings / name)
    runs = tuple(
        drive(dataset, dataset.rows[first:last], f"robot-{number}")
        for number, (first, last) in enumerate(cuts)
    )
    truth = np.concatenate([truth_of(dataset, run.stamps_s) for run in runs])
    return Robots(dataset=dataset, runs=runs, truth=truth)


def joined_poses(runs: Sequence[Run], merged: MergedMap) -> Array:
    """Return the poses of all frames in the merged map's world."""
    parts = []
    first = 0
    for run in runs:
        count = len(run.version.keyframes)
        keyframes = merged.version.keyframes[first : first + count]
        parts.append(frame_poses(run, np.array([keyframe.T_world_camera for keyframe in keyframes])))
        first += count
    return np.concatenate(parts)


def origin_errors(robots: Robots, merged: MergedMap) -> list[tuple[float, float]]:
    """Return for each other robot how far its start is off in the first one's frame (m, deg)."""
    poses = joined_poses(robots.runs, merged)
    starts = np.cumsum([0] + [len(run.rows) for run in robots.runs])[:-1]
    return [
        pose_difference(
            inverse(poses[0]) @ poses[start], inverse(robots.truth[0]) @ robots.truth[start]
        )
        for start in starts[1:]
    ]  # fmt: skip


def cloud_distances(robots: Robots, merged: MergedMap) -> tuple[float, float]:
    """Return the median distance (m) of the merged cloud to the true one, and the share under 5 cm.

    Both clouds are built from every fifth frame.  The merged one is aligned by whole poses: the positions of
    a drive of two metres alone leave a degree or two of rotation open.
    """
    import small_gicp

    poses = joined_poses(robots.runs, merged)
    rows = [row for run in robots.runs for row in run.rows]
    T_truth_merged = alignment_of_poses(poses, robots.truth)
    true_cloud = cloud_of(robots.dataset, rows[::5], robots.truth[::5]).points()[0]
    own_cloud = cloud_of(robots.dataset, rows[::5], T_truth_merged @ poses[::5]).points()[0]
    tree = small_gicp.KdTree(small_gicp.PointCloud(true_cloud.astype(np.float64)))
    chosen = own_cloud[:: max(1, len(own_cloud) // 50_000)].astype(np.float64)
    distances = np.sqrt(np.asarray(tree.batch_nearest_neighbor_search(chosen)[1]))
    return float(np.median(distances)), float((distances < 0.05).mean())


def plant_wrong_links(share: float, seed: int) -> Callable[[Atlas, MergeOptions, Report], LoopProposals]:
    """Return a proposer that replaces a share of the measured links by wrong ones."""

    def propose(atlas: Atlas, options: MergeOptions, report: Report) -> LoopProposals:
        proposals = propose_links(atlas, options, report)
        rng = np.random.default_rng(seed)
        links = list(proposals.links)
        for k in rng.choice(len(links), max(1, round(share * len(links))), replace=False).tolist():
            off = exp_se3(rng.uniform(-1, 1, 6) * [1.5, 1.5, 1.5, 1.0, 1.0, 1.0])
            links[k] = LoopClosure(
                a=links[k].a, b=links[k].b, T_a_b=links[k].T_a_b @ off, information=links[k].information
            )
        return LoopProposals(links=tuple(links), failed=proposals.failed)

    return propose


def alignment_of_poses(T_estimate: Array, T_truth: Array) -> Array:
    """Return the rigid motion that brings whole poses ``(n, 4, 4)`` closest: mean rotation, then shift."""
    relative = T_truth[:, :3, :3] @ np.swapaxes(T_estimate[:, :3, :3], 1, 2)
    U, _, Vt = np.linalg.svd(relative.sum(axis=0))
    T = np.eye(4)
    T[:3, :3] = U @ Vt
    T[:3, 3] = (T_truth[:, :3, 3] - T_estimate[:, :3, 3] @ T[:3, :3].T).mean(axis=0)
    return T


def localise_every_fifth(recordings: Path) -> tuple[float, Array]:
    """Locate every fifth frame in a map of the others with true poses.

    Returns the share that was found, and the ``(n, 2)`` errors of what was found, m and degrees.
    """
    dataset = open_dataset(recordings / RED_KITCHEN)
    truth = truth_of(dataset, dataset.timestamps_s)
    frames = [keyframe_of(dataset, row, truth[place], place) for place, row in enumerate(dataset.rows)]
    index, asked = MapIndex([frame for frame in frames if frame.id % 5]), frames[::5]
    errors = []
    for frame in asked:
        pixels = frame.pixels.astype(np.float64)
        found = locate(index, View(camera=frame.camera, pixels=pixels, descriptors=frame.descriptors))
        if found.verdict == "ok" and found.inliers >= LOCALISE_INLIERS and found.T_map_camera is not None:
            errors.append(pose_difference(found.T_map_camera, frame.T_world_camera))
    return len(errors) / len(asked), np.array(errors)

"""Frames of the recordings as a live map gets them, and the map in which their places are sought."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client_sdk.datasets import open_dataset
from client_sdk.frontend import Features, FrontEndOptions, extract
from rse_pf.geometry import Array, Camera, inverse, pose_difference, transform
from rse_pf.live_map.measure import measure_links, reference_of_features, view_of_features
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.slam.keyframe import Keyframe as SentKeyframe
from rse_pf.slam.keyframe import KeyframeFeatures, encode_keyframe, make_features
from rse_pf.slam.localise import Localised, PlacedKeyframe, localise, spread_candidates
from rse_pf.slam.map_merge import merge_versions
from rse_pf.slam.places import PlaceIndex, place_vector
from tests.recorded_drives import RED_KITCHEN, Run, drive, frame_poses

SPACING_M, SPACING_DEG = 0.1, 6.0
CANDIDATES, SEARCHED = 10, 60
OVERLAP = 0.4
LOOP_FRAMES = 20  # neighbours of a view along its drive are no test of recall


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A frame as the map gets it; *T* is its true pose, where that is known."""

    row: int
    features: KeyframeFeatures
    extracted: Features
    camera: Camera
    timestamp_s: float
    T: Array | None

    @property
    def size_bytes(self) -> int:
        keyframe = SentKeyframe(
            timestamp_s=self.timestamp_s,
            T_odom_camera=np.eye(4),
            camera=self.camera,
            features=self.features,
        )
        return len(encode_keyframe(keyframe))


def views_of(recordings: Path, name: str) -> list[View]:
    """Return the frames of a recording with the features that live maps send."""
    dataset = open_dataset(recordings / name)
    poses = [None] * len(dataset) if dataset.truth is None else list(dataset.truth.T_world_camera)
    views = []
    for row, (frame, T) in enumerate(zip(dataset, poses, strict=False)):
        found = extract(frame, FrontEndOptions.live())
        features = make_features(found.pixels, found.points_camera[:, 2], found.descriptors)
        stamp_s = frame.timestamp_s
        views.append(
            View(row=row, features=features, extracted=found, camera=frame.camera, timestamp_s=stamp_s, T=T)
        )
    return views


def space_out(poses: Sequence[Array], rows: Iterable[int]) -> list[int]:
    """Return *rows* that become dense keyframes."""
    dense: list[int] = []
    for row in rows:
        if dense:
            metres, degrees = pose_difference(poses[dense[-1]], poses[row])
            if metres <= SPACING_M and degrees <= SPACING_DEG:
                continue
        dense.append(row)
    return dense


class PlacedMap:
    """Keyframes with their poses, ready to be searched."""

    def __init__(self, views: Sequence[View], poses: Sequence[Array]) -> None:
        self._views, self._poses, self._index = views, np.array(poses), PlaceIndex()
        for number, view in enumerate(views):
            self._index.add(number, place_vector(view.features.descriptors))

    def find(self, view: View) -> Localised:
        """Return the place of a view."""
        near = self._index.nearest(place_vector(view.features.descriptors), SEARCHED)
        candidates = []
        for row in spread_candidates(near, self._poses, CANDIDATES):
            known = self._views[row]
            reference = reference_of_features(known.features, known.camera)
            candidates.append(PlacedKeyframe(id=row, reference=reference, T_map_keyframe=self._poses[row]))
        return localise(candidates, view_of_features(view.features, view.camera))


def kitchen_map(recordings: Path, views: Sequence[View]) -> tuple[PlacedMap, Array]:
    """Return the map of the frames that are not each fifth, and every frame's pose in it."""
    run = drive(open_dataset(recordings / RED_KITCHEN), range(len(views)), "robot")
    rows = space_out(list(run.T_world_camera), [row for row in range(len(views)) if row % 5])
    keyframes = [_keyframe(views[row], run.T_world_camera[row], number) for number, row in enumerate(rows)]
    version = MapVersion(keyframes=tuple(keyframes))
    merged = sorted(merge_versions([version]).version.keyframes, key=lambda each: each.timestamp_s)
    poses = np.array([keyframe.T_world_camera for keyframe in merged])
    owner = np.maximum(0, np.searchsorted(rows, np.arange(len(views)), side="right") - 1)
    whole = Run(
        version=version,
        stamps_s=run.stamps_s,
        T_world_camera=run.T_world_camera,
        keyframe_of_frame=owner,
        rows=run.rows,
    )
    return PlacedMap([views[row] for row in rows], list(poses)), frame_poses(whole, poses)


def recall(pool: Sequence[View], queries: Sequence[View]) -> list[tuple[bool, float]]:
    """Say of each query with overlapping keyframes if one is among the best ten, and what share of them."""
    known = np.array([place_vector(view.features.descriptors) for view in pool])
    scores = []
    for query in queries:
        near = {place for place, view in enumerate(pool) if abs(view.row - query.row) <= LOOP_FRAMES}
        others = set(range(len(pool))) - near
        overlapping = {place for place in others if _overlap(query, pool[place])}
        if overlapping:
            similarity = known @ place_vector(query.features.descriptors)
            similarity[sorted(near)] = -2.0
            best = np.argsort(-similarity, kind="stable")[:CANDIDATES].tolist()
            hits = len(overlapping.intersection(best))
            scores.append((hits > 0, hits / min(CANDIDATES, len(overlapping))))
    return scores


def _overlap(one: View, other: View) -> bool:
    """Say whether two views show the same, as poses and a measured link agree."""
    if min(_share_in_view(one, other), _share_in_view(other, one)) < OVERLAP:
        return False
    sent = (1, other.features, other.camera)
    return bool(measure_links((0, one.features, one.camera), [sent]).links)


def _share_in_view(one: View, other: View) -> float:
    """Return the share of the points of *one* that lie in the image of *other*."""
    points = transform(inverse(other.T) @ one.T, one.features.points_camera(one.camera))
    ahead = points[:, 2] > 0.2
    pixels = other.camera.project(np.where(ahead[:, None], points, 1.0))
    inside = ((pixels >= 0.0) & (pixels < (other.camera.width, other.camera.height))).all(axis=1)
    return float((ahead & inside).mean()) if len(points) else 0.0


def _keyframe(view: View, T_world_camera: Array, number: int) -> Keyframe:
    found = view.extracted
    return Keyframe(
        id=number,
        robot="robot",
        timestamp_s=view.timestamp_s,
        T_world_camera=T_world_camera,
        camera=view.camera,
        pixels=found.pixels.astype(np.float32),
        descriptors=found.descriptors,
        points_camera=found.points_camera.astype(np.float32),
    )

"""Measure how a live map codes keyframes, finds places and relocalises.

Defends: at most 34 kB a keyframe; place search with its vector <= 7 ms p50 at 2,000 keyframes, and hardly
more at 10,000; as many views with an overlapping keyframe among the best ten as with a vocabulary that is
trained for the map; a measured pair <= 5 ms p50; of each fifth kitchen frame >= 80 % found within 2 s, median
within 1 cm / 0.5 deg of the map's own poses and 3.5 cm / 2 deg of the truth; no foreign frame called ok; two
equal places are ambiguous.  CPU times are of this process, with one thread for linear algebra.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks live.places --recordings ../shared/data --out live_places.json
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.frame.registry import Bar, Recordings, benchmark
from benchmarks.frame.statistics import spread
from benchmarks.maps.recordings import RED_KITCHEN, Run, drive, frame_poses
from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame, FrontEndOptions, extract
from client_sdk.simulator import SIMULATED_CAMERA, true_trajectory
from client_sdk.simulator.camera import Painter, add_depth_noise, add_image_noise
from client_sdk.simulator.world import make_world
from rse_pf.experiments.results.trajectory_error import ate_m
from rse_pf.geometry import Array, Camera, inverse, pose_difference, rotation_angle_deg, transform
from rse_pf.live_map.measure import measure_links, reference_of_features, view_of_features
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.slam.keyframe import Keyframe as SentKeyframe
from rse_pf.slam.keyframe import KeyframeFeatures, encode_keyframe, make_features
from rse_pf.slam.localise import Localised, PlacedKeyframe, localise, spread_candidates
from rse_pf.slam.map_merge import merge_versions
from rse_pf.slam.places import PLACE_NUMBERS, PlaceIndex, place_vector

__all__ = []

SMALL = ("tum_fr1_xyz_start", "redwood_living_room", "nyu_dining_room")
SPACING_M, SPACING_DEG = 0.1, 6.0
CANDIDATES, SEARCHED = 10, 60
OVERLAP, LOOP_FRAMES, LOOP_RENDERED = 0.4, 20, 7
"""Neighbours of a view along its drive are no test of recall."""
ROUND, FOREIGN_SEEDS = 410, (201, 202, 203, 204, 205, 206)
ELSEWHERE = np.array([[1, 0, 0, 40.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A frame as the map gets it; *T* is its true pose, where that is known."""

    source: str
    row: int
    features: KeyframeFeatures
    full: tuple[Array, npt.NDArray[np.uint8], Array]
    """Pixels, descriptors and points of all features."""
    size_bytes: int
    camera: Camera
    timestamp_s: float
    T: Array | None


def views_of(source: str, frames: Iterable[Frame], poses: Iterable[Array | None]) -> list[View]:
    """Return frames as views, with the features that live maps send."""
    views = []
    for row, frame, T in zip(count(), frames, poses, strict=False):
        extracted = extract(frame, FrontEndOptions.live())
        features = make_features(extracted.pixels, extracted.points_camera[:, 2], extracted.descriptors)
        data = encode_keyframe(
            SentKeyframe(
                timestamp_s=frame.timestamp_s, T_odom_camera=np.eye(4), camera=frame.camera, features=features
            )
        )
        views.append(
            View(
                source=source, row=row, features=features,
                full=(extracted.pixels, extracted.descriptors, extracted.points_camera), size_bytes=len(data),
                camera=frame.camera, timestamp_s=frame.timestamp_s, T=T,
            )
        )  # fmt: skip
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


def code_row(views: Sequence[View], rows: Sequence[int]) -> dict[str, Any]:
    """Return bytes and the cost of a pair, over all pairs of keyframes."""
    took_ms, links = [], 0
    for place, a in enumerate(rows):
        for b in rows[:place]:
            one, other = views[a], views[b]
            start = time.process_time()
            measured = measure_links((0, one.features, one.camera), [(1, other.features, other.camera)])
            took_ms.append((time.process_time() - start) * 1e3)
            links += len(measured.links)
    sizes = [view.size_bytes for view in views]
    return {
        "keyframe_bytes": {"mean": round(float(np.mean(sizes))), "max": max(sizes), "n": len(sizes)},
        "pair_ms": spread(took_ms), "links": links,
    }  # fmt: skip


def recall_rows(pool: Sequence[View], queries: Sequence[View]) -> dict[str, Any]:
    """Return the share of queries with an overlapping keyframe among the best ten, by source."""
    truth = [_overlapping(query, pool) for query in queries]
    known = np.array([place_vector(view.features.descriptors) for view in pool])
    scored: dict[str, list[tuple[bool, float]]] = {}
    for query, overlapping in zip(queries, truth, strict=True):
        if not overlapping:
            continue
        similarity = known @ place_vector(query.features.descriptors)
        for place, candidate in enumerate(pool):
            if _is_neighbour(query, candidate):
                similarity[place] = -2.0
        best = np.argsort(-similarity, kind="stable")[:CANDIDATES]
        hits = sum(int(place) in overlapping for place in best)
        score = (hits > 0, hits / min(CANDIDATES, len(overlapping)))
        scored.setdefault(query.source, []).append(score)
    return {
        source: {
            "found_percent": round(100.0 * float(np.mean([hit for hit, _ in scores])), 1),
            "of_all_percent": round(100.0 * float(np.mean([share for _, share in scores])), 1),
            "n": len(scores),
        }
        for source, scores in scored.items()
    }


def search_rows(views: Sequence[View]) -> dict[str, Any]:
    """Return the cost of a vector, and of a search among so many keyframes."""
    rows: dict[str, Any] = {"vector_ms": _time(place_vector, [view.features.descriptors for view in views])}
    rng = np.random.default_rng(1)
    for keyframes in (1000, 2000, 5000, 10_000):
        vectors = rng.normal(size=(keyframes, PLACE_NUMBERS)).astype(np.float32)
        index = PlaceIndex()
        for number, vector in enumerate(vectors):
            index.add(number, vector)
        rows[f"search_ms_{keyframes}"] = _time(
            lambda v, index=index: index.nearest(v, SEARCHED), vectors[:200]
        )
    return rows


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedMap:
    """Keyframes with their poses, ready to be searched."""

    keyframes: Sequence[tuple[int, KeyframeFeatures, Camera, Array]]
    index: PlaceIndex
    T_map_camera: Array

    @classmethod
    def of(cls, views: Sequence[View], poses: Sequence[Array]) -> PlacedMap:
        """Return the map of *views* at *poses*."""
        index = PlaceIndex()
        for number, view in enumerate(views):
            index.add(number, place_vector(view.features.descriptors))
        keyframes = [(n, v.features, v.camera, T) for n, (v, T) in enumerate(zip(views, poses, strict=True))]
        return cls(keyframes=keyframes, index=index, T_map_camera=np.array(poses))

    def find(self, view: View) -> Localised:
        """Return the place of a view."""
        near = self.index.nearest(place_vector(view.features.descriptors), SEARCHED)
        chosen = spread_candidates(near, self.T_map_camera, CANDIDATES)
        candidates = [
            PlacedKeyframe(id=number, reference=reference_of_features(features, camera), T_map_keyframe=T)
            for number, features, camera, T in (self.keyframes[row] for row in chosen)
        ]
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
        version=version, stamps_s=run.stamps_s, T_world_camera=run.T_world_camera, keyframe_of_frame=owner,
        rows=run.rows,
    )  # fmt: skip
    return PlacedMap.of([views[row] for row in rows], list(poses)), frame_poses(whole, poses)


def relocalise_row(known: PlacedMap, views: Sequence[View], T_map_camera: Array) -> dict[str, Any]:
    """Return how well each fifth view is found."""
    T_truth = np.array([view.T for view in views])
    T_map_world, rotation = _align(T_map_camera, T_truth)
    verdicts: Counter[str] = Counter()
    by_map, by_truth, took_ms = [], [], []
    for row in range(0, len(views), 5):
        start = time.process_time()
        localised = known.find(views[row])
        took_ms.append((time.process_time() - start) * 1e3)
        verdicts[f"{localised.verdict} {localised.reason}".strip()] += 1
        if localised.verdict == "ok" and localised.T_map_camera is not None:
            by_map.append(pose_difference(localised.T_map_camera, T_map_camera[row]))
            away = localised.T_map_camera[:3, 3] - (T_map_world @ T_truth[row])[:3, 3]
            turned = localised.T_map_camera[:3, :3].T @ rotation @ T_truth[row][:3, :3]
            by_truth.append((float(np.linalg.norm(away)), rotation_angle_deg(turned)))
    return {
        "verdicts": dict(verdicts), "keyframes": len(known.keyframes), "ms": spread(took_ms),
        "map_ate_cm": round(100.0 * ate_m(T_map_camera, T_truth), 2),
        "by_map_m_deg": _medians(by_map), "by_truth_m_deg": _medians(by_truth),
    }  # fmt: skip


def verdicts_of(known: PlacedMap, views: Iterable[View]) -> dict[str, int]:
    """Return how often each verdict was given."""
    given = Counter(f"{localised.verdict} {localised.reason}".strip() for localised in map(known.find, views))
    return dict(given)


@benchmark(
    Bar("code.keyframe_bytes.max", at_most=34_000, unit="bytes"),
    Bar("code.pair_ms.p50", at_most=5.0, unit="ms of CPU"),
)
def run_benchmark(*, recordings: Recordings = Path("../shared/data")) -> dict[str, Any]:
    """Measure, print and write."""
    sources = {name: _load_views(recordings, name) for name in (RED_KITCHEN, *SMALL)}
    kitchen = sources[RED_KITCHEN]
    rendered = _render_views(7, range(0, ROUND, 2))
    foreign = [view for name in SMALL for view in sources[name]]
    foreign += [view for seed in FOREIGN_SEEDS for view in _render_views(seed, range(seed % 10, ROUND, 13))]
    foreign = foreign[:200]
    dense = space_out([_true(view) for view in kitchen], range(len(kitchen)))
    dense_rendered = space_out([_true(view) for view in rendered], range(len(rendered)))
    pool = [kitchen[row] for row in dense] + [rendered[row] for row in dense_rendered]
    pool += [view for name in SMALL for view in sources[name]]
    queries = kitchen[::3] + rendered[::2] + [view for name in SMALL for view in sources[name]]
    known, T_map_camera = kitchen_map(recordings, kitchen)
    halves = rendered[::2], rendered[1::2]
    house = PlacedMap.of(halves[0], [_true(view) for view in halves[0]])
    twins = [replace(view, T=ELSEWHERE @ _true(view)) for view in halves[1]]
    both = [*(view for place, view in enumerate(halves[0]) if place % 3), *twins]
    return {
        "code": code_row(kitchen, dense),
        "recall": recall_rows(pool, queries),
        "search": search_rows(pool),
        "relocalise_kitchen": relocalise_row(known, kitchen, T_map_camera),
        "foreign_to_kitchen": verdicts_of(known, foreign),
        "foreign_to_rendered": verdicts_of(house, foreign),
        "own_of_rendered": verdicts_of(house, halves[1]),
        "two_equal_houses": verdicts_of(PlacedMap.of(both, [_true(v) for v in both]), halves[0][::3]),
    }


def _load_views(recordings: Path, name: str) -> list[View]:
    dataset = open_dataset(recordings / name)
    poses = [None] * len(dataset) if dataset.truth is None else list(dataset.truth.T_world_camera)
    return views_of(name, dataset, poses)


def _render_views(seed: int, rows: range) -> list[View]:
    poses = true_trajectory(0, 1, ROUND, seed).T_world_camera[rows.start : rows.stop : rows.step]
    return views_of(f"rendered {seed}", _frames(seed, poses), list(poses))


def _frames(seed: int, poses: Array) -> Iterator[Frame]:
    painter = Painter(make_world(seed), SIMULATED_CAMERA)
    for row, T_world_camera in enumerate(poses):
        rng = np.random.default_rng([seed, row])
        colour, depth_m, cosine = painter.draw(T_world_camera)
        yield Frame(
            timestamp_s=float(row), rgb=add_image_noise(colour, rng),
            depth_m=add_depth_noise(depth_m, cosine, rng), camera=SIMULATED_CAMERA,
        )  # fmt: skip


def _true(view: View) -> Array:
    assert view.T is not None
    return view.T


def _keyframe(view: View, T_world_camera: Array, number: int) -> Keyframe:
    pixels, descriptors, points = view.full
    return Keyframe(
        id=number, robot="robot", timestamp_s=view.timestamp_s, T_world_camera=T_world_camera,
        camera=view.camera, pixels=pixels.astype(np.float32), descriptors=descriptors,
        points_camera=points.astype(np.float32),
    )  # fmt: skip


def _is_neighbour(query: View, other: View) -> bool:
    if query.source != other.source:
        return False
    near = {RED_KITCHEN: LOOP_FRAMES, "rendered 7": LOOP_RENDERED // 2}.get(query.source, 0)
    return abs(query.row - other.row) <= near


def _overlapping(query: View, pool: Sequence[View]) -> set[int]:
    """Return the places in *pool* that show the same, as poses and a measured link agree."""
    overlapping: set[int] = set()
    for place, other in enumerate(pool):
        if query.source != other.source or _is_neighbour(query, other):
            continue
        is_long = query.source not in SMALL
        if is_long and min(_share_in_view(query, other), _share_in_view(other, query)) < OVERLAP:
            continue
        if measure_links((0, query.features, query.camera), [(1, other.features, other.camera)]).links:
            overlapping.add(place)
    return overlapping


def _share_in_view(one: View, other: View) -> float:
    """Return the share of the points of *one* that lie in the image of *other*."""
    points = transform(inverse(_true(other)) @ _true(one), one.features.points_camera(one.camera))
    ahead = points[:, 2] > 0.2
    pixels = other.camera.project(np.where(ahead[:, None], points, 1.0))
    inside = ((pixels >= 0.0) & (pixels < (other.camera.width, other.camera.height))).all(axis=1)
    return float((ahead & inside).mean()) if len(points) else 0.0


def _align(T_estimate: Array, T_truth: Array) -> tuple[Array, Array]:
    """Return the transform of the true positions to the estimated ones, and the rotation of rotations."""
    a, b = T_estimate[:, :3, 3], T_truth[:, :3, 3]
    T = np.eye(4)
    T[:3, :3] = _nearest_rotation((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    T[:3, 3] = a.mean(axis=0) - T[:3, :3] @ b.mean(axis=0)
    turned = np.einsum("kij,klj->il", T_estimate[:, :3, :3], T_truth[:, :3, :3])
    return T, _nearest_rotation(turned)


def _nearest_rotation(matrix: Array) -> Array:
    U, _, Vt = np.linalg.svd(matrix)
    rotation: Array = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return rotation


def _time(call: Any, inputs: Iterable[Any]) -> dict[str, float]:
    took_ms = []
    for value in inputs:
        start = time.process_time()
        call(value)
        took_ms.append((time.process_time() - start) * 1e3)
    return spread(took_ms)


def _medians(values: Sequence[tuple[float, float]]) -> dict[str, list[float]]:
    errors = np.asarray(values)
    return {
        "median": np.median(errors, axis=0).round(4).tolist(), "max": errors.max(axis=0).round(4).tolist()
    }  # fmt: skip

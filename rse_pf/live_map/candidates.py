"""Choose the keyframes of a live map that a new one is compared with, and those that are redundant."""

from __future__ import annotations

import math

import numpy as np

from rse_pf.live_map.graph import MapGraph
from rse_pf.slam.place_recognition import PlaceIndex

__all__ = ["choose_candidates", "find_redundant_keyframes"]

MIN_LOOP_STEPS = 0.8
"""Steps of odometry that two keyframes of one segment are apart, at least, before they are compared; a loop
closure between closer ones would only repeat the odometry."""
MIN_LOOP_STEPS_UNDER_LOAD = 12.0
"""Steps of odometry that two keyframes of one segment are apart, at least, before an overloaded map server
compares them: drift is small over a shorter path, so its loop closure would correct little."""
SAME_VIEW_M = 0.12  # metres along each axis, at most, between two keyframes with the same view
SAME_VIEW_DEG = 8.0  # degrees of rotation, at most, between two keyframes with the same view
MAX_KEYFRAMES_OF_VIEW = 2
"""Keyframes with the same view that keep their features, the newest ones; the features of older ones are
redundant, and are dropped."""


def choose_candidates(
    graph: MapGraph, places: PlaceIndex, keyframe: int, limit: int, *, is_overloaded: bool = False
) -> list[int]:
    """Return the ids of up to *limit* keyframes that may show the same place as *keyframe*, ascending.

    At most half of *limit* are from other components, which loop closures may join with that of the keyframe.
    Keyframes of the keyframe's own component fill the rest of *limit*, also if other components have fewer.

    Args:
        graph: The graph.
        places: Place recognition vectors of all keyframes with features.
        keyframe: The new keyframe.
        limit: Largest number of candidates.
        is_overloaded: Whether to leave out keyframes of the same segment within 12 steps of odometry, and not
            only those within 0.8 steps.
    """
    rows = graph.segment_rows
    vector = places.vector_of(keyframe)
    # 1. Leave out keyframes without features, of excluded segments, and those shortly before or after on the
    #    path of the same segment.
    is_excluded = np.array([segment.is_excluded for segment in graph.segments])[rows]
    is_allowed = graph.has_features & ~is_excluded
    is_allowed[keyframe] = False
    min_steps = MIN_LOOP_STEPS_UNDER_LOAD if is_overloaded else MIN_LOOP_STEPS
    is_close = rows == rows[keyframe]
    is_close &= np.abs(graph.odometry_steps - graph.odometry_steps[keyframe]) < min_steps
    # 2. Ask place recognition, separately for other components and for the keyframe's own one.
    is_own = graph.components == graph.components[keyframe]
    from_others = places.nearest(vector, limit // 2, np.flatnonzero(is_allowed & ~is_own))
    own_limit = limit - len(from_others)
    from_own = places.nearest(vector, own_limit, np.flatnonzero(is_allowed & is_own & ~is_close))
    return sorted(i for i, _ in from_own + from_others)


def find_redundant_keyframes(graph: MapGraph, keyframe: int) -> tuple[int, ...]:
    """Return the ids of the keyframes whose features are redundant after *keyframe* was added, ascending.

    Two keyframes have the same view if they are within 0.12 m along each axis and within 8 degrees.  Of the
    keyframes with the view of *keyframe*, itself among them, the two with the largest ids keep their
    features, and all others but *keyframe* are redundant.  Only keyframes with features that are connected
    with the map count.  The result is empty if *keyframe* is not connected with the map.
    """
    if not graph.is_aligned(int(graph.segment_rows[keyframe])):
        return ()
    T = graph.T_component_camera
    # 1. Find keyframes at the same position; the first coordinate alone excludes most keyframes of the map.
    is_near = np.abs(T[:, 0, 3] - T[keyframe, 0, 3]) <= SAME_VIEW_M
    near = np.flatnonzero(graph.has_features & is_near)
    distance_m = np.abs(T[near, :3, 3] - T[keyframe, :3, 3]).max(axis=1)
    near = near[distance_m <= SAME_VIEW_M]
    # 2. Of those, find keyframes with the same rotation.
    traces = np.einsum("nij,ij->n", T[near, :3, :3], T[keyframe, :3, :3])
    near = near[traces >= 1.0 + 2.0 * math.cos(math.radians(SAME_VIEW_DEG))]
    # 3. All but the newest two of those that are connected with the map are redundant.
    in_map = [i for i in near.tolist() if graph.is_aligned(int(graph.segment_rows[i]))]
    surplus = max(0, len(in_map) - MAX_KEYFRAMES_OF_VIEW)
    return tuple(i for i in in_map[:surplus] if i != keyframe)

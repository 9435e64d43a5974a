"""Fit the poses around what changed to their edges by robust Gauss-Newton, those farther away held.

Pure numbers, by one thread and in a fixed order: the same numbers give the same bytes.  It is for some dozens
of poses; `rse_pf.services.mapping.optimise` fits a whole graph.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, rotation_angle_deg
from rse_pf.live_map.graph import Graph
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.services.mapping.loop_consistency import OdometryNoise
from rse_pf.services.mapping.pose_graph import inverses

__all__ = [
    "Edges",
    "SmoothedPoses",
    "SmoothedWindows",
    "edges_of",
    "exp_se3_many",
    "log_se3_many",
    "odometry_step",
    "smooth",
    "smooth_all",
    "smooth_around",
]

Rows = npt.NDArray[np.int64]

_LEAST_STEP = 0.05
_ITERATIONS = 6
_CONVERGED_M, _CONVERGED_RAD = 6e-3, 6e-3
_LITTLE = 1e-3
"""Share of the cost below which another step is not worth its time; after steps below 6 mm and 6 mrad the
next one is ten times shorter, and the next keyframe's smoothing makes it."""
_DAMPING = 1e-6
"""Of the diagonal; a free pose without an edge to a held one stays where it is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmoothedPoses:
    """The result of `smooth`.

    ``T`` ``(n, 4, 4)``; ``squares`` ``(m,)`` the squared Mahalanobis norm of each edge's residual;
    ``covariances`` ``(w, 6, 6)`` of the wanted poses, of twists on the right of a pose, given the held ones.
    """

    T: Array
    squares: Array
    covariances: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges:
    """Edges between keyframes ``a`` and ``b`` (ids); ``numbers`` are those of links, -1 for odometry."""

    a: Rows
    b: Rows
    T_a_b: Array
    information: Array
    numbers: Rows


@dataclass(slots=True, kw_only=True, eq=False)
class SmoothedWindows:
    """What `smooth_around` did.

    ``strained`` says that even the largest window was too small; ``misfit`` is the mean squared misfit of the
    links; ``squares`` that of each believed link that was smoothed; ``keyframes`` counts those of all windows
    that were tried.
    """

    strained: bool = False
    misfit: float = 0.0
    squares: dict[int, float] = field(default_factory=dict)
    keyframes: int = 0
    _covariances: dict[int, Array] = field(default_factory=dict)

    def covariance(self, graph: Graph, keyframe: int) -> Array | None:
        """Return the ``(6, 6)`` covariance of the newest pose of a segment, if it moved, given those held.

        It is of the twist (metres, radians) on the left of the pose, in the frame of the map.
        """
        right = self._covariances.get(keyframe)
        if right is None:
            return None
        adjoint = _adjoints(graph.T[keyframe][None])[0]
        left: Array = adjoint @ (0.5 * (right + right.T)) @ adjoint.T
        return left


def smooth_around(
    graph: Graph, moved: Sequence[int], anchors: Iterable[int], options: LiveMapOptions
) -> SmoothedWindows:
    """Smooth *graph* around the keyframes *moved*, one component after the other; the graph changes.

    The window grows while its border moves.  *anchors* are keyframes that define the frame of a component.
    """
    done = SmoothedWindows()
    held = set(anchors)
    groups: dict[int, list[int]] = {}
    for i in moved:
        if graph.of_segment[i] >= 0:
            groups.setdefault(graph.component_of(i), []).append(i)
    total = 0.0
    newest = [
        graph.segments[row].keyframes[-1] for row in graph.newest.values() if graph.segments[row].keyframes
    ]
    for _, seeds in sorted(groups.items()):
        for size in options.windows:
            ids, is_whole = _window(graph, seeds, size, held)
            if not ids:
                break
            edges = edges_of(graph, ids, options)
            if not len(edges.a):
                break
            inside = set(ids)
            told = [i for i in newest if i in inside]
            done.keyframes += len(ids)
            found, border, rows = _fit(graph, ids, told, edges, options)
            is_strained = not is_whole and _is_moved(graph, border, found, rows, options)
            if not is_strained or size == options.windows[-1]:
                done.strained |= is_strained
                graph.T[ids] = found.T[: len(ids)]
                squares = {
                    int(number): float(square)
                    for number, square in zip(edges.numbers, found.squares, strict=True) if number >= 0
                }  # fmt: skip
                done.squares |= squares
                total += sum(squares.values())
                done._covariances |= dict(zip(told, found.covariances, strict=True))
                break
    done.misfit = total / max(1, len(done.squares))
    return done


def smooth_all(graph: Graph, options: LiveMapOptions) -> None:
    """Smooth each segment of *graph* once, by the largest window; the graph changes."""
    largest, anchors = max(options.windows), graph.anchors()
    options = replace(options, windows=(largest,))
    for segment in graph.segments:
        for begin in range(0, len(segment.keyframes), largest):
            smooth_around(graph, segment.keyframes[begin : begin + largest], anchors, options)


def edges_of(graph: Graph, ids: Iterable[int], options: LiveMapOptions) -> Edges:
    """Return odometry and believed links that touch one of the keyframes *ids*."""
    links: set[int] = set()
    steps: set[tuple[int, int]] = set()
    for i in ids:
        links.update(graph.links_at(i))
        steps.update(graph.steps_at(i))
    numbers = sorted(links)
    pairs = np.array(sorted(steps), dtype=np.int64).reshape(-1, 2)
    a, b = pairs[:, 0], pairs[:, 1]
    walked = graph.way[b] - graph.way[a]
    drift: OdometryNoise = options.drift
    spread = np.array([drift.step_m] * 3 + [math.radians(drift.step_deg)] * 3) ** -2.0
    chain = np.zeros((len(a), 6, 6))
    chain[:, range(6), range(6)] = spread / walked[:, None]
    measured = [graph.links[number] for number in numbers]
    if not measured:
        T_a_b, information = np.empty((0, 4, 4)), np.empty((0, 6, 6))
    else:
        T_a_b = np.array([link.T_a_b for link in measured])
        information = np.array([link.information for link in measured])
    return Edges(
        a=np.concatenate([a, np.array([link.a for link in measured], dtype=np.int64)]),
        b=np.concatenate([b, np.array([link.b for link in measured], dtype=np.int64)]),
        T_a_b=np.concatenate([inverses(graph.T_odom[a]) @ graph.T_odom[b], T_a_b]),
        information=np.concatenate([chain, information]),
        numbers=np.concatenate([np.full(len(a), -1), np.array(numbers, dtype=np.int64)]),
    )


def odometry_step(T_from_to: Array, options: LiveMapOptions) -> float:
    """Return how many steps of the odometry's noise a motion is."""
    moved = float(np.sqrt((T_from_to[:3, 3] ** 2).sum())) / options.spacing_m
    turned = rotation_angle_deg(T_from_to[:3, :3]) / options.spacing_deg
    return max(moved, turned, _LEAST_STEP)


def smooth(
    T: Array, free: int, a: Rows, b: Rows, T_a_b: Array, information: Array, robust: npt.NDArray[np.bool_],
    *, cauchy: float, wanted: Rows | None = None,
) -> SmoothedPoses:  # fmt: skip
    """Fit the first *free* of the poses to the edges; the others are held.

    Minimises ``sum of squares`` of the edges that are not robust, and the sum of
    ``cauchy**2 log(1 + squares / cauchy**2)`` of the others.

    Args:
        T: ``(n, 4, 4)`` poses, metres.
        free: How many of them may move; at least 1.
        a, b: ``(m,)`` row numbers of the poses of each edge.
        T_a_b: ``(m, 4, 4)``, measured.
        information: ``(m, 6, 6)``, of the twist (metres, radians).
        robust: ``(m,)``, whether the edge may be wrong.
        cauchy: Width of the kernel, standard deviations.
        wanted: Rows of free poses whose covariance is asked for.

    Source:
        Dellaert and Kaess, Factor Graphs for Robot Perception (2017), chapter 6.
    """
    T = T.copy()
    back = inverses(T_a_b)
    T_a_b_now, error, squares = _residuals(T, a, b, back, information)
    cost = _cost(squares, robust, cauchy)
    wanted = np.empty(0, dtype=np.int64) if wanted is None else wanted
    units = np.zeros((6 * free, 6 * len(wanted)))
    units[(6 * wanted[:, None] + np.arange(6)).ravel(), np.arange(6 * len(wanted))] = 1.0
    solved: Array = np.empty((6 * free, 1 + 6 * len(wanted)))
    for _ in range(_ITERATIONS):
        weights = _weights(squares, robust, cauchy)
        H, gradient = _normal_equations(T_a_b_now, free, a, b, error, information, weights)
        solved = np.linalg.solve(H, np.column_stack([-gradient, units])).astype(np.float64, copy=False)
        step = _bounded(solved[:, 0].reshape(free, 6))
        for _ in range(4):
            moved = T.copy()
            moved[:free] = _orthonormal(T[:free] @ exp_se3_many(step))
            T_moved, new_error, new_squares = _residuals(moved, a, b, back, information)
            new_cost = _cost(new_squares, robust, cauchy)
            if new_cost <= cost:
                break
            step = 0.25 * step
        else:
            break
        little = cost - new_cost <= _LITTLE * cost
        T, T_a_b_now, error, squares, cost = moved, T_moved, new_error, new_squares, new_cost
        moved_m, turned_rad = np.abs(step[:, :3]).max(), np.abs(step[:, 3:]).max()
        if little or (moved_m < _CONVERGED_M and turned_rad < _CONVERGED_RAD):
            break
    rows = 6 * wanted[:, None] + np.arange(6)
    columns = 1 + 6 * np.arange(len(wanted))[:, None] + np.arange(6)
    return SmoothedPoses(T=T, squares=squares, covariances=solved[rows[:, :, None], columns[:, None, :]])


def exp_se3_many(xi: Array) -> Array:
    """Return the ``(n, 4, 4)`` poses of ``(n, 6)`` twists (metres, radians); as `geometry.exp_se3`."""
    rho, phi = xi[:, :3], xi[:, 3:]
    angle = np.sqrt((phi**2).sum(axis=1))
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24.0, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)
    c = np.where(small, 1.0 / 6.0, (1.0 - a) / safe**2)
    K = _skews(phi)
    KK = K @ K
    T = np.zeros((len(xi), 4, 4))
    T[:, :3, :3] = np.eye(3) + a[:, None, None] * K + b[:, None, None] * KK
    jacobian = np.eye(3) + b[:, None, None] * K + c[:, None, None] * KK
    T[:, :3, 3] = (jacobian @ rho[:, :, None])[:, :, 0]
    T[:, 3, 3] = 1.0
    return T


def log_se3_many(T: Array) -> Array:
    """Return the ``(n, 6)`` twists of ``(n, 4, 4)`` poses; as `pose_graph.log_se3`, in half the time.

    Less exact where a rotation is within 0.1 degrees of half a turn.
    """
    R = T[:, :3, :3]
    v = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.sqrt((v * v).sum(axis=1))
    angle = np.arctan2(sine, 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0))
    small = sine < 1e-5
    phi = v * np.where(small & (angle < 1.0), 1.0, angle / np.maximum(sine, 1e-12))[:, None]
    half = np.where(angle < 1e-4, 1.0, 0.5 * angle)
    c = np.where(angle < 1e-4, 1.0 / 12.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    K = _skews(phi)
    across = K @ T[:, :3, 3:]
    rho = T[:, :3, 3:] - 0.5 * across + c[:, None, None] * (K @ across)
    return np.concatenate([rho[:, :, 0], phi], axis=1)


def _window(graph: Graph, seeds: Sequence[int], size: int, held: set[int]) -> tuple[list[int], bool]:
    """Return up to *size* keyframes around *seeds*, nearest first, and whether they are the whole component.

    Where there are more seeds, the newest are taken.
    """
    front = [i for i in seeds if i not in held][-size:]
    seen = set(front)
    ids = list(front)
    while front:
        following: list[int] = []
        for i in front:
            for other, _ in graph.neighbours(i):
                if other not in seen and other not in held:
                    if len(ids) == size:
                        return ids, False
                    seen.add(other)
                    ids.append(other)
                    following.append(other)
        front = following
    return ids, len(front) == 0 and len(seeds) <= size


def _fit(
    graph: Graph, ids: list[int], told: list[int], edges: Edges, options: LiveMapOptions
) -> tuple[SmoothedPoses, Rows, dict[int, int]]:
    """Return the smoothed poses, the keyframes of the window that touch its border, and rows by id."""
    row_of = np.full(len(graph), -1, dtype=np.int64)
    row_of[ids] = np.arange(len(ids))
    a_inside, b_inside = row_of[edges.a] >= 0, row_of[edges.b] >= 0
    border = np.concatenate([edges.a[a_inside & ~b_inside], edges.b[b_inside & ~a_inside]])
    beyond = np.unique(np.concatenate([edges.b[a_inside & ~b_inside], edges.a[b_inside & ~a_inside]]))
    row_of[beyond] = len(ids) + np.arange(len(beyond))
    found = smooth(
        graph.T[np.concatenate([ids, beyond])], len(ids), row_of[edges.a], row_of[edges.b], edges.T_a_b,
        edges.information, edges.numbers >= 0, cauchy=options.cauchy, wanted=row_of[told],
    )  # fmt: skip
    return found, np.unique(border), {i: row for row, i in enumerate(ids)}


def _is_moved(
    graph: Graph, border: Rows, found: SmoothedPoses, rows: dict[int, int], options: LiveMapOptions
) -> bool:
    """Return whether a keyframe at the border of the window moved by more than it may."""
    if not len(border):
        return False
    old, new = graph.T[border], found.T[[rows[i] for i in border.tolist()]]
    moved2_m2 = ((new[:, :3, 3] - old[:, :3, 3]) ** 2).sum(axis=1).max()
    traces = (old[:, :3, :3] * new[:, :3, :3]).sum(axis=(1, 2))
    least_trace = 1.0 + 2.0 * math.cos(math.radians(options.border_deg))
    return bool(moved2_m2 > options.border_m**2 or traces.min() < least_trace)


def _residuals(T: Array, a: Rows, b: Rows, back: Array, information: Array) -> tuple[Array, Array, Array]:
    """Return ``T_a_b`` by the poses, its twist from the measured one, and the squared norm of that."""
    T_a_b = inverses(T[a]) @ T[b]
    error = log_se3_many(back @ T_a_b)
    weighted = (information @ error[:, :, None])[:, :, 0]
    return T_a_b, error, (error * weighted).sum(axis=1)


def _weights(squares: Array, robust: npt.NDArray[np.bool_], cauchy: float) -> Array:
    return np.where(robust, 1.0 / (1.0 + squares / cauchy**2), 1.0)


def _cost(squares: Array, robust: npt.NDArray[np.bool_], cauchy: float) -> float:
    return float(np.where(robust, cauchy**2 * np.log1p(squares / cauchy**2), squares).sum())


def _normal_equations(
    T_a_b: Array, free: int, a: Rows, b: Rows, error: Array, information: Array, weights: Array
) -> tuple[Array, Array]:
    """Return the matrix ``(6 f, 6 f)`` and the gradient ``(6 f,)`` of the free poses."""
    J_b = np.eye(6) + 0.5 * _small_adjoints(error)
    J_a = -J_b @ _adjoints(inverses(T_a_b))
    J = np.concatenate([J_a, J_b], axis=2)
    WJ = (weights[:, None, None] * information) @ J
    blocks = np.swapaxes(J, 1, 2) @ WJ
    slopes = (np.swapaxes(WJ, 1, 2) @ error[:, :, None])[:, :, 0]
    # Sums over the edges of a pose are products with ones and zeros, for the sake of time.
    poses = np.arange(free)[:, None]
    at_a, at_b = (a == poses).astype(np.float64), (b == poses).astype(np.float64)
    own = at_a @ blocks[:, :6, :6].reshape(-1, 36) + at_b @ blocks[:, 6:, 6:].reshape(-1, 36)
    both = np.flatnonzero((a < free) & (b < free))
    across = 36 * (a[both] * free + b[both])[:, None] + np.arange(36)
    summed = np.bincount(across.ravel(), weights=blocks[both, :6, 6:].ravel(), minlength=36 * free * free)
    # It counts in integers where there is nothing to add.
    half: Array = summed.astype(np.float64, copy=False).reshape(free, free, 6, 6)
    half[np.arange(free), np.arange(free)] = 0.5 * own.reshape(free, 6, 6)
    flat = np.ascontiguousarray(half.transpose(0, 2, 1, 3)).reshape(6 * free, 6 * free)
    H = flat + flat.T
    diagonal = np.arange(6 * free)
    H[diagonal, diagonal] += _DAMPING * (H[diagonal, diagonal] + 1.0)
    return H, (at_a @ slopes[:, :6] + at_b @ slopes[:, 6:]).reshape(-1)


def _bounded(step: Array) -> Array:
    """Return the step, shortened where a rotation is beyond what a linear step means."""
    largest = float(np.abs(step[:, 3:]).max())
    return step * (0.5 / largest) if largest > 0.5 else step


def _orthonormal(T: Array) -> Array:
    """Return poses whose rotations are orthonormal again, by one Newton step of the polar form."""
    R = T[:, :3, :3]
    T = T.copy()
    T[:, :3, :3] = 1.5 * R - 0.5 * R @ np.swapaxes(R, 1, 2) @ R
    return T


def _skews(v: Array) -> Array:
    K = np.zeros((len(v), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    K[:, 1, 0], K[:, 2, 0], K[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return K


def _adjoints(T: Array) -> Array:
    """Return ``(n, 6, 6)``: what a twist (rho, phi) in the frame on the right is in that on the left."""
    R = T[:, :3, :3]
    adjoint = np.zeros((len(T), 6, 6))
    adjoint[:, :3, :3] = adjoint[:, 3:, 3:] = R
    adjoint[:, :3, 3:] = _skews(T[:, :3, 3]) @ R
    return adjoint


def _small_adjoints(xi: Array) -> Array:
    """Return ``(n, 6, 6)``: the commutator with a twist, for the first order of a Jacobian."""
    small = np.zeros((len(xi), 6, 6))
    small[:, :3, :3] = small[:, 3:, 3:] = _skews(xi[:, 3:])
    small[:, :3, 3:] = _skews(xi[:, :3])
    return small

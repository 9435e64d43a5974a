"""Pose graphs: poses, measured relative poses between them, their misfit, and their g2o text.

A graph is validated once, in its constructor.

Residual of edge *k* between poses *a* and *b*: ``log(inverse(T_a_b) @ inverse(T_world_a) @ T_world_b)``,
a twist ``(rho metres, phi radians)``; ``information`` is the inverse covariance of that twist.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, from_quaternion, inverse, log_se3, rigid_many, to_quaternion

__all__ = [
    "PoseGraph",
    "components",
    "g2o_edge",
    "g2o_vertex",
    "is_positive_definite",
    "misfit",
    "read_g2o",
    "write_g2o",
]

_UPPER = np.triu_indices(6)
_MAX_ID = 2**53
_MAX_M, _MAX_INFORMATION = 1e9, 1e18
"""Larger numbers overflow in what optimises a graph."""
_FROM_G2O = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
"""g2o's rotation error is the vector part of a quaternion, half of phi."""
_TO_G2O = np.linalg.inv(_FROM_G2O)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseGraph:
    """*n* poses and *m* edges between them.

    Attributes:
        T_world_pose: ``(n, 4, 4)``, metres.
        a, b: ``(m,)`` row numbers of the poses that an edge connects.
        T_a_b: ``(m, 4, 4)``, the measured relative poses.
        information: ``(m, 6, 6)``, symmetric, positive definite, of the twist (metres, radians).
        robust: ``(m,)``, whether an edge may be an outlier (loops and merges) or not (odometry).
        ids: ``(n,)``, the names of the poses in a file or request.

    Raises:
        BadRequest: Shapes do not agree, an edge connects a pose to itself or to an unknown one, a number is
            not finite, a matrix is not a rotation, or an information matrix is not positive definite.
    """

    T_world_pose: Array
    a: npt.NDArray[np.int64]
    b: npt.NDArray[np.int64]
    T_a_b: Array
    information: Array
    robust: npt.NDArray[np.bool_]
    ids: npt.NDArray[np.int64]

    def __post_init__(self) -> None:
        n, m = len(self.T_world_pose), len(self.a)
        shapes = (
            self.T_world_pose.shape == (n, 4, 4) and self.ids.shape == (n,) and n > 0
            and self.b.shape == self.a.shape == self.robust.shape == (m,)
            and self.T_a_b.shape == (m, 4, 4) and self.information.shape == (m, 6, 6)
        )  # fmt: skip
        if not shapes:
            raise BadRequest("the shapes of the pose graph do not agree", hint="send one row for each edge")
        if m and (min(self.a.min(), self.b.min()) < 0 or max(self.a.max(), self.b.max()) >= n):
            raise BadRequest(f"an edge names a pose that is not one of 0..{n - 1}", hint="send all poses")
        if (self.a == self.b).any():
            raise BadRequest("an edge connects a pose to itself", hint="leave it out")
        if len(np.unique(self.ids)) != n:
            raise BadRequest("two poses have one id", hint="give each pose its own id")
        # Frozen from here on.
        object.__setattr__(self, "T_world_pose", _checked_poses("a pose", self.T_world_pose))
        object.__setattr__(self, "T_a_b", _checked_poses("an edge", self.T_a_b))
        if not is_positive_definite(self.information):
            raise BadRequest(
                "an information matrix is not symmetric and positive definite", hint="invert a covariance"
            )

    def chi2(self, T_world_pose: Array | None = None) -> float:
        """Return the sum of squared residuals, each weighted with its information."""
        poses = self.T_world_pose if T_world_pose is None else T_world_pose
        return float(self.squared_residuals(poses).sum())

    def squared_residuals(self, T_world_pose: Array) -> Array:
        """Return the ``(m,)`` squared Mahalanobis norms of the residuals at *T_world_pose*."""
        predicted = inverse(T_world_pose[self.a]) @ T_world_pose[self.b]
        return misfit(self.T_a_b, predicted, self.information)


def misfit(measured: Array, predicted: Array, information: Array) -> Array:
    """Return the ``(m,)`` squared Mahalanobis norms between ``(m, 4, 4)`` poses."""
    error = log_se3(inverse(measured) @ predicted)
    squares: Array = np.einsum("mi,mij,mj->m", error, information, error)
    return squares


def is_positive_definite(information: Array) -> bool:
    """Say whether ``(m, 6, 6)`` matrices are symmetric, positive definite and not absurdly large."""
    if not len(information):
        return True
    if not (np.abs(information) <= _MAX_INFORMATION).all():
        return False
    scale = np.abs(information).max(axis=(1, 2))
    skewed = np.abs(information - np.swapaxes(information, 1, 2)).max(axis=(1, 2)) > 1e-6 * scale
    return not skewed.any() and bool((np.linalg.eigvalsh(information)[:, 0] > 0).all())


def components(n: int, a: npt.NDArray[np.int64], b: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return for each of *n* poses the smallest row number of its connected component."""
    root = list(range(n))

    def find(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    for one, other in zip(a.tolist(), b.tolist(), strict=True):
        one, other = find(one), find(other)
        root[max(one, other)] = min(one, other)
    return np.array([find(i) for i in range(n)], dtype=np.int64)


def write_g2o(graph: PoseGraph) -> str:
    """Return *graph* as g2o text (``VERTEX_SE3:QUAT``, ``EDGE_SE3:QUAT``).

    The rotation error of g2o is the vector part of a quaternion, so the information matrices are written
    for ``phi / 2``.
    """
    lines = [g2o_vertex(name, T) for name, T in zip(graph.ids.tolist(), graph.T_world_pose, strict=True)]
    ids_a, ids_b = graph.ids[graph.a].tolist(), graph.ids[graph.b].tolist()
    lines += [
        g2o_edge(a, b, T_a_b, information)
        for a, b, T_a_b, information in zip(ids_a, ids_b, graph.T_a_b, graph.information, strict=True)
    ]
    return "\n".join(lines) + "\n"


def g2o_vertex(name: int, T_world_pose: Array) -> str:
    """Return the line of g2o for the pose of this id."""
    return f"VERTEX_SE3:QUAT {name} {_join(_pose_numbers(T_world_pose))}"


def g2o_edge(a: int, b: int, T_a_b: Array, information: Array) -> str:
    """Return the line of g2o for an edge between the poses with ids *a* and *b*.

    Args:
        a: The id of the first pose.
        b: The id of the second pose.
        T_a_b: ``(4, 4)``, metres.
        information: ``(6, 6)``, of the twist (metres, radians).
    """
    upper = (_TO_G2O @ information @ _TO_G2O)[_UPPER]
    return f"EDGE_SE3:QUAT {a} {b} {_join(_pose_numbers(T_a_b))} {_join(upper)}"


def read_g2o(text: str) -> PoseGraph:
    """Return the graph of g2o *text*; edges between consecutive ids are odometry.

    Raises:
        BadRequest: A line is not one of ``VERTEX_SE3:QUAT``, ``EDGE_SE3:QUAT`` and ``FIX``, or has the wrong
            numbers; the message has the line number.
    """
    vertices: dict[int, Array] = {}
    edges: list[tuple[int, int, Array, Array]] = []
    for number, tag, words in _lines(text):
        try:
            if tag == "VERTEX_SE3:QUAT":
                vertices[_id(words[0])] = _pose(words[1:])
            elif tag == "EDGE_SE3:QUAT":
                information = np.zeros((6, 6))
                information[_UPPER] = _information(words[9:])
                information = np.triu(information) + np.triu(information, 1).T
                edges.append((_id(words[0]), _id(words[1]), _pose(words[2:9]), information))
            elif tag != "FIX":
                raise ValueError(f"{tag[:40]!r} is not a 3-D pose or edge")
        except (ValueError, IndexError) as error:
            raise BadRequest(f"g2o, line {number}: {error}", hint="send 3-D pose graphs only") from error
    row = {name: i for i, name in enumerate(vertices)}
    missing = next((name for a, b, _, _ in edges for name in (a, b) if name not in row), None)
    if missing is not None:
        raise BadRequest(f"g2o: an edge names vertex {missing}, which is missing", hint="send all vertices")
    m = len(edges)
    ids = np.array(list(vertices), dtype=np.int64)
    a = np.array([row[edge[0]] for edge in edges], dtype=np.int64)
    b = np.array([row[edge[1]] for edge in edges], dtype=np.int64)
    return PoseGraph(
        T_world_pose=np.array(list(vertices.values())).reshape(-1, 4, 4),
        a=a,
        b=b,
        T_a_b=np.array([edge[2] for edge in edges]).reshape(m, 4, 4),
        information=_FROM_G2O @ np.array([edge[3] for edge in edges]).reshape(m, 6, 6) @ _FROM_G2O,
        robust=np.abs(ids[a] - ids[b]) != 1,
        ids=ids,
    )


def _lines(text: str) -> Iterator[tuple[int, str, list[str]]]:
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words[0], words[1:]


def _id(word: str) -> int:
    number = int(word)
    if abs(number) > _MAX_ID:
        raise ValueError("an id is not within 53 bits")
    return number


def _information(words: list[str]) -> list[float]:
    numbers = [float(word) for word in words]
    if not all(abs(value) <= _MAX_INFORMATION for value in numbers):
        raise ValueError(f"a number of the information is not within {_MAX_INFORMATION:g}")
    return numbers


def _pose_numbers(T: Array) -> Array:
    return np.concatenate([T[:3, 3], to_quaternion(T[:3, :3])])


def _join(values: Array) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _pose(words: list[str]) -> Array:
    numbers = [float(word) for word in words]
    if len(numbers) != 7 or not all(abs(value) <= _MAX_M for value in numbers):
        raise ValueError(f"a pose is x y z qx qy qz qw, each of at most {_MAX_M:g}")
    if np.linalg.norm(numbers[3:]) < 1e-6:
        raise ValueError("a quaternion is zero")
    T = np.eye(4)
    T[:3, :3] = from_quaternion(numbers[3:])
    T[:3, 3] = numbers[:3]
    return T


def _checked_poses(what: str, T: Array) -> Array:
    made = rigid_many(T, _MAX_M)
    if made is None:
        raise BadRequest(
            f"{what} is not a rigid motion, or has a matrix that is not a rotation",
            hint="send (4, 4) matrices of finite numbers with at least three decimals",
        )
    return made

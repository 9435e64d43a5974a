"""Represent pose graphs, measure how well poses fit their edges, and read and write them as g2o text.

The residual of an edge between the poses *a* and *b* is ``log(inverse(T_a_b) @ inverse(T_world_a) @
T_world_b)``, a twist (translation in metres, rotation in radians); ``information`` is the inverse covariance
of this twist.
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
    "connected_components",
    "g2o_edge",
    "g2o_vertex",
    "is_positive_definite",
    "read_g2o",
    "write_g2o",
]

_UPPER = np.triu_indices(6)
# Largest absolute id of a vertex in g2o text, which JSON and float64 hold exactly; a text with a larger one
# is refused.
_MAX_ID = 2**53
# Largest absolute coordinate of a pose in metres, beyond any map; a graph with a larger one is refused.
_MAX_COORDINATE_M = 1e9
# Largest absolute number of an information matrix, a standard deviation of 1 nm or 1 nrad; a graph with a
# larger one is refused.
_MAX_INFORMATION = 1e18
_MAX_ASYMMETRY = 1e-6
"""Largest absolute element of an information matrix minus its transpose, as a share of the largest absolute
element of the matrix.  A matrix with a larger one is refused as not symmetric."""
_FROM_G2O = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
"""Derivative of g2o's error (translation, vector part of a quaternion) by our twist: the vector part of a
quaternion is half of a small rotation vector."""
_TO_G2O = np.linalg.inv(_FROM_G2O)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseGraph:
    """A pose graph of *n* poses and *m* edges, which is validated when it is made.

    Rotations in ``T_world_pose`` and ``T_a_b`` that are not exact are replaced by the nearest rotations, in a
    copy of the array (`rse_pf.geometry.rigid_many`).

    Attributes:
        T_world_pose: ``(n, 4, 4)``, metres.
        a, b: ``(m,)``, the rows of the two poses of each edge.
        T_a_b: ``(m, 4, 4)``, the measured relative poses, metres.
        information: ``(m, 6, 6)``, symmetric and positive definite, of the twist (metres, radians).
        robust: ``(m,)``, whether an edge may be an outlier, so that the cost applies a robust kernel to its
            residual: True for loop closures, False for odometry.
        ids: ``(n,)``, the ids of the poses in a file or a command.

    Raises:
        BadRequest: Shapes do not agree, there is no pose, two poses have one id, an edge connects a pose with
            itself or an unknown pose, a number is not finite or too large, a matrix is not a rotation, or an
            information matrix is not positive definite.
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
        has_right_shapes = (
            self.T_world_pose.shape == (n, 4, 4)
            and self.ids.shape == (n,)
            and n > 0
            and self.b.shape == self.a.shape == self.robust.shape == (m,)
            and self.T_a_b.shape == (m, 4, 4)
            and self.information.shape == (m, 6, 6)
        )
        if not has_right_shapes:
            raise BadRequest(
                f"the shapes of the pose graph of {n} poses and {m} edges do not agree",
                hint="send at least one pose, and one row for each edge in each array",
            )
        if m and (min(self.a.min(), self.b.min()) < 0 or max(self.a.max(), self.b.max()) >= n):
            raise BadRequest(f"an edge names a pose that is not one of 0..{n - 1}", hint="send all poses")
        if (self.a == self.b).any():
            raise BadRequest("an edge connects a pose to itself", hint="leave this edge out")
        if len(np.unique(self.ids)) != n:
            raise BadRequest("two poses have one id", hint="give each pose its own id")
        # Check the poses, and replace those that are not exact; a frozen dataclass allows no other way.
        object.__setattr__(self, "T_world_pose", _checked_poses("a pose", self.T_world_pose))
        object.__setattr__(self, "T_a_b", _checked_poses("an edge", self.T_a_b))
        if not is_positive_definite(self.information):
            raise BadRequest(
                "an information matrix is not symmetric and positive definite",
                hint="send the inverses of the covariances of the edges",
            )

    def squared_residuals(self, T_world_pose: Array) -> Array:
        """Return the squared Mahalanobis norms ``(m,)`` of the residuals at *T_world_pose* ``(n, 4, 4)``."""
        T_a_b = inverse(T_world_pose[self.a]) @ T_world_pose[self.b]
        residuals = log_se3(inverse(self.T_a_b) @ T_a_b)
        squares: Array = np.einsum("mi,mij,mj->m", residuals, self.information, residuals)
        return squares


def is_positive_definite(information: Array) -> bool:
    """Return whether all matrices ``(m, 6, 6)`` are symmetric and positive definite, with numbers up to 1e18.

    A number that is not finite gives False; no matrices give True.
    """
    if not len(information):
        return True
    if not (np.abs(information) <= _MAX_INFORMATION).all():
        return False
    largest = np.abs(information).max(axis=(1, 2))
    asymmetry = np.abs(information - np.swapaxes(information, 1, 2)).max(axis=(1, 2))
    is_symmetric = not (asymmetry > _MAX_ASYMMETRY * largest).any()
    return is_symmetric and bool((np.linalg.eigvalsh(information)[:, 0] > 0).all())


def connected_components(n: int, a: npt.NDArray[np.int64], b: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return for each node of a graph the smallest node of its connected component, ``(n,)``, by union-find.

    Args:
        n: The number of nodes, such as poses, which are numbered from 0.
        a: ``(m,)``, the first node of each edge.
        b: ``(m,)``, the second node of each edge.
    """
    parent = list(range(n))

    def find_root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for edge_a, edge_b in zip(a.tolist(), b.tolist(), strict=True):
        root_a, root_b = find_root(edge_a), find_root(edge_b)
        parent[max(root_a, root_b)] = min(root_a, root_b)
    return np.array([find_root(i) for i in range(n)], dtype=np.int64)


def write_g2o(graph: PoseGraph) -> str:
    """Return *graph* as g2o text with lines ``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT``.

    Which edges may be outliers is not written.
    """
    lines = [g2o_vertex(name, T) for name, T in zip(graph.ids.tolist(), graph.T_world_pose, strict=True)]
    ids_a, ids_b = graph.ids[graph.a].tolist(), graph.ids[graph.b].tolist()
    lines += [
        g2o_edge(a, b, T_a_b, information)
        for a, b, T_a_b, information in zip(ids_a, ids_b, graph.T_a_b, graph.information, strict=True)
    ]
    return "\n".join(lines) + "\n"


def g2o_vertex(name: int, T_world_pose: Array) -> str:
    """Return the g2o line of the pose *T_world_pose* ``(4, 4)`` with the id *name*."""
    return f"VERTEX_SE3:QUAT {name} {_join(_pose_numbers(T_world_pose))}"


def g2o_edge(a: int, b: int, T_a_b: Array, information: Array) -> str:
    """Return the g2o line of an edge between the poses with the ids *a* and *b*.

    The rotational error of g2o is the vector part of a quaternion, half of our rotation vector, and the
    information matrix is converted to it.

    Args:
        a: The id of the first pose.
        b: The id of the second pose.
        T_a_b: ``(4, 4)``, metres.
        information: ``(6, 6)``, of the twist (metres, radians).
    """
    upper = (_TO_G2O @ information @ _TO_G2O)[_UPPER]
    return f"EDGE_SE3:QUAT {a} {b} {_join(_pose_numbers(T_a_b))} {_join(upper)}"


def read_g2o(text: str) -> PoseGraph:
    """Return the pose graph of g2o *text*.

    Edges between ids that differ by 1 count as odometry, all others may be outliers (`PoseGraph.robust`).
    Lines ``FIX`` and comments are ignored, and of several vertices with one id the last pose is used.

    Raises:
        BadRequest: A line is not one of ``VERTEX_SE3:QUAT``, ``EDGE_SE3:QUAT`` and ``FIX``, or has the wrong
            numbers; the message has the line number.  Or the graph is invalid, see `PoseGraph`.
    """
    # 1. Read the lines.
    vertices: dict[int, Array] = {}
    edges: list[tuple[int, int, Array, Array]] = []
    for number, tag, words in _tagged_lines(text):
        try:
            if tag == "VERTEX_SE3:QUAT":
                vertices[_parse_id(words[0])] = _parse_pose(words[1:])
            elif tag == "EDGE_SE3:QUAT":
                information = np.zeros((6, 6))
                information[_UPPER] = _parse_information(words[9:])
                information = np.triu(information) + np.triu(information, 1).T
                edge_ids = _parse_id(words[0]), _parse_id(words[1])
                edges.append((*edge_ids, _parse_pose(words[2:9]), information))
            elif tag != "FIX":
                raise ValueError(f"{tag[:40]!r} is not a 3-D pose or edge")
        except (ValueError, IndexError) as error:
            raise BadRequest(f"g2o, line {number}: {error}", hint="send 3-D pose graphs only") from error
    # 2. Replace the ids in edges by the rows of the poses.
    row_of_id = {name: row for row, name in enumerate(vertices)}
    missing = next((name for a, b, _, _ in edges for name in (a, b) if name not in row_of_id), None)
    if missing is not None:
        raise BadRequest(f"g2o: an edge names vertex {missing}, which is missing", hint="send all vertices")
    m = len(edges)
    ids = np.array(list(vertices), dtype=np.int64)
    a = np.array([row_of_id[edge[0]] for edge in edges], dtype=np.int64)
    b = np.array([row_of_id[edge[1]] for edge in edges], dtype=np.int64)
    # 3. Convert the information matrices from g2o's error to the twist of `PoseGraph`.
    g2o_information = np.array([edge[3] for edge in edges]).reshape(m, 6, 6)
    return PoseGraph(
        T_world_pose=np.array(list(vertices.values())).reshape(-1, 4, 4),
        a=a,
        b=b,
        T_a_b=np.array([edge[2] for edge in edges]).reshape(m, 4, 4),
        information=_FROM_G2O @ g2o_information @ _FROM_G2O,
        robust=np.abs(ids[a] - ids[b]) != 1,
        ids=ids,
    )


def _tagged_lines(text: str) -> Iterator[tuple[int, str, list[str]]]:
    """Yield number, first word and further words of each line that is not empty and no comment."""
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words[0], words[1:]


def _parse_id(word: str) -> int:
    number = int(word)
    if abs(number) > _MAX_ID:
        raise ValueError(f"the id {word[:40]} is not within +-2**53")
    return number


def _parse_information(words: list[str]) -> list[float]:
    numbers = [float(word) for word in words]
    if not all(abs(value) <= _MAX_INFORMATION for value in numbers):
        raise ValueError(f"a number of the information is not within +-{_MAX_INFORMATION:g}")
    return numbers


def _pose_numbers(T: Array) -> Array:
    return np.concatenate([T[:3, 3], to_quaternion(T[:3, :3])])


def _join(values: Array) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _parse_pose(words: list[str]) -> Array:
    """Return the pose of the seven numbers x y z qx qy qz qw; raises ValueError if they are no pose."""
    numbers = [float(word) for word in words]
    if len(numbers) != 7 or not all(abs(value) <= _MAX_COORDINATE_M for value in numbers):
        raise ValueError(f"a pose is x y z qx qy qz qw, each within +-{_MAX_COORDINATE_M:g}")
    if np.linalg.norm(numbers[3:]) < 1e-6:
        raise ValueError("a quaternion is zero")
    T = np.eye(4)
    T[:3, :3] = from_quaternion(numbers[3:])
    T[:3, 3] = numbers[:3]
    return T


def _checked_poses(subject: str, T: Array) -> Array:
    """Return poses *T* ``(n, 4, 4)`` with exact rotations; raises BadRequest if one is no pose.

    *subject*, such as "an edge", begins the message of the error.
    """
    poses = rigid_many(T, _MAX_COORDINATE_M)
    if poses is None:
        raise BadRequest(
            f"{subject} is not a rigid motion, or has a matrix that is not a rotation",
            hint="send (4, 4) matrices of finite numbers with at least three decimals",
        )
    return poses

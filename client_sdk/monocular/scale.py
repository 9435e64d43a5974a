"""Metres per unit of a map without depth: from the robot's odometry, or from a marker of known size.

Each source collects what it needs frame by frame, and gives the scale once it is well determined.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import numpy.typing as npt

from client_sdk.monocular.bundle import Bundle, adjust
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, inverse
from rse_pf.images import load_opencv
from rse_pf.slam.triangulation import parallax_deg, triangulate

__all__ = ["MarkerScale", "OdometryScale"]

_MAX_STAMP_DIFFERENCE_S = 0.05
_MIN_ODOMETRY_FRAMES = 5
_MIN_MARKER_VIEWS = 4
_MIN_MARKER_PARALLAX_DEG = 5.0


class OdometryScale:
    """Scale by the path that odometry measured: the ratio of the spread of both paths."""

    def __init__(
        self,
        timestamps_s: Array | None = None,
        positions_m: Array | None = None,
        *,
        first_m: float = 1.0,
    ) -> None:
        """Use the first *first_m* metres of odometry.

        Args:
            timestamps_s: ``(n,)``, ascending; None if each frame is given with its position.
            positions_m: ``(n, 3)`` of the camera in any fixed frame, metres.
            first_m: Length of the path that is used; the scale is known after it.

        Raises:
            UsageError: The arrays do not fit, or the length is not above 0.
        """
        if not first_m > 0:
            raise UsageError(f"first_m = {first_m:g} is not above 0", hint="use 1 metre")
        if (timestamps_s is None) != (positions_m is None) or (
            timestamps_s is not None
            and positions_m is not None
            and positions_m.shape != (len(timestamps_s), 3)
        ):
            raise UsageError(
                "time stamps and positions of odometry do not fit", hint="give one position for each stamp"
            )
        self.name = f"the first {first_m:g} m of odometry"
        self._first_m = first_m
        self._recorded = None if timestamps_s is None else np.asarray(timestamps_s, dtype=np.float64)
        self._positions = None if positions_m is None else np.asarray(positions_m, dtype=np.float64)
        self._seen: dict[float, Array] = {}

    def observe(self, timestamp_s: float, rgb: npt.NDArray[np.uint8], position_m: Array | None) -> None:
        """Take the position of one frame; without one, the nearest of the recorded ones."""
        if position_m is None and self._recorded is not None and self._positions is not None:
            row = int(np.argmin(np.abs(self._recorded - timestamp_s)))
            if abs(self._recorded[row] - timestamp_s) <= _MAX_STAMP_DIFFERENCE_S:
                position_m = self._positions[row]
        if position_m is not None:
            self._seen[round(timestamp_s, 6)] = np.asarray(position_m, dtype=np.float64)

    def is_due(self, timestamp_s: float, *, is_known: bool) -> bool:
        """Return whether the scale is sought: not after it is known."""
        return not is_known

    def metres_per_unit(
        self, timestamps_s: Array, T_world_camera: Array, camera: Camera, depth: float
    ) -> float | None:
        """Return the scale once *first_m* metres have passed since the first pose.

        Source:
            Horn, JOSA A 1987, Sect. 2.E (scale without rotation).
        """
        rows = [row for row, stamp in enumerate(timestamps_s) if round(float(stamp), 6) in self._seen]
        if len(rows) < _MIN_ODOMETRY_FRAMES:
            return None
        measured = np.array([self._seen[round(float(timestamps_s[row]), 6)] for row in rows])
        path_m = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(measured, axis=0), axis=1))))
        if path_m[-1] < self._first_m:
            return None
        end = max(int(np.searchsorted(path_m, self._first_m)) + 1, _MIN_ODOMETRY_FRAMES)
        spread_m = _spread(measured[:end])
        spread = _spread(T_world_camera[rows[:end], :3, 3])
        return spread_m / spread if spread > 0 and spread_m > 0 else None


class MarkerScale:
    """Scale by a square ArUco marker (dictionary 4x4_50) that several frames see."""

    def __init__(self, size_m: float) -> None:
        """Seek markers whose black square is *size_m* wide.

        Raises:
            UsageError: The size is not within 5 mm to 5 m.
        """
        if not 0.005 <= size_m <= 5.0:
            raise UsageError(
                f"a marker of {1000 * size_m:g} mm is not within 5..5000 mm",
                hint="measure the black square, in millimetres",
            )
        self.name = f"a marker of {1000 * size_m:g} mm"
        self._size_m = size_m
        self._seen: defaultdict[int, dict[float, Array]] = defaultdict(dict)

    def observe(self, timestamp_s: float, rgb: npt.NDArray[np.uint8], position_m: Array | None) -> None:
        """Find the corners of markers in one image; raises MissingExtra."""
        cv2 = load_opencv()
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        corners, identities, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(
            cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        )
        for each, identity in zip(corners, () if identities is None else identities.ravel(), strict=True):
            self._seen[int(identity)][round(timestamp_s, 6)] = each.reshape(4, 2).astype(np.float64)

    def is_due(self, timestamp_s: float, *, is_known: bool) -> bool:
        """Return whether the scale is sought: not after it is known."""
        return not is_known

    def metres_per_unit(
        self, timestamps_s: Array, T_world_camera: Array, camera: Camera, depth: float
    ) -> float | None:
        """Return the scale by the marker that is seen with the largest parallax."""
        found = [
            self._by_marker(views, timestamps_s, T_world_camera, camera) for views in self._seen.values()
        ]
        known = [each for each in found if each is not None]
        return max(known)[1] if known else None

    def _by_marker(
        self, views: dict[float, Array], timestamps_s: Array, T_world_camera: Array, camera: Camera
    ) -> tuple[float, float] | None:
        """Return parallax and scale of one marker, or None if it is not well determined."""
        rows = [row for row, stamp in enumerate(timestamps_s) if round(float(stamp), 6) in views]
        if len(rows) < _MIN_MARKER_VIEWS:
            return None
        poses = np.stack([inverse(T_world_camera[row]) for row in rows])
        corners = np.stack([views[round(float(timestamps_s[row]), 6)] for row in rows])
        centres = T_world_camera[rows, :3, 3]
        far = int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))
        points, good = triangulate(poses[0], poses[far], corners[0], corners[far], camera, max_error_px=4.0)
        if not good.all():
            return None
        angle = float(parallax_deg(points, centres[0], centres[far]).mean())
        if angle < _MIN_MARKER_PARALLAX_DEG:
            return None
        count = len(rows)
        bundle = Bundle(
            T_camera_world=poses, is_fixed=np.ones(count, dtype=bool), points_world=points,
            cameras=np.repeat(np.arange(count), 4), points=np.tile(np.arange(4), count),
            pixels=corners.reshape(-1, 2), sigma_px=np.full(4 * count, 0.5),
        )  # fmt: skip
        _, points = adjust(bundle, camera)
        edges = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        if edges.max() > 1.2 * edges.min():  # not the square that it should be
            return None
        return angle, self._size_m / float(edges.mean())


def _spread(positions: Array) -> float:
    return float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum()))

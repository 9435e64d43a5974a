"""Metres per unit of a map without depth: from the robot's odometry, or from a marker of known size.

Each source collects its measurements frame by frame, and returns the scale once they determine it well.
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
"""Largest difference, in seconds, between the times of a frame and of a recorded position that belong
together."""
_STAMP_DIGITS = 6
"""Digits after the point to which time stamps in seconds are rounded, so that the time of a tracked pose
finds the measurements of the same frame."""
_MIN_ODOMETRY_FRAMES = 5
"""Fewest frames with a position from which odometry gives the scale."""
_MIN_MARKER_VIEWS = 4
"""Fewest frames that must show a marker before it gives the scale."""
_MIN_MARKER_PARALLAX_DEG = 5.0
"""Smallest mean parallax of a marker's corners, in degrees, between the first view of the marker and the view
farthest from it: with less, the marker gives no scale."""
_MAX_CORNER_ERROR_PX = 4.0
"""Largest reprojection error of a marker's corner that is triangulated, in pixels: with a larger one, the
marker gives no scale."""
_CORNER_SIGMA_PX = 0.5
"""Standard deviation of a marker's corner, in pixels, after its refinement."""
_MAX_EDGE_RATIO = 1.2
"""Largest ratio of the longest and the shortest edge of a triangulated marker, which is a square."""
_MIN_MARKER_M = 0.005
"""Smallest width of a marker, in metres."""
_MAX_MARKER_M = 5.0
"""Largest width of a marker, in metres."""


class OdometryScale:
    """Metric scale by odometry: the spread of the measured path divided by that of the tracked path.

    The spread of a path is the root of the sum of squared distances of its positions from their mean.
    ``name`` describes the source of the scale in reports.
    """

    def __init__(
        self,
        timestamps_s: Array | None = None,
        positions_m: Array | None = None,
        *,
        first_m: float = 1.0,
    ) -> None:
        """Use the first *first_m* metres of odometry.

        Args:
            timestamps_s: ``(n,)`` seconds, ascending; None if `observe` is given the position of each frame.
            positions_m: ``(n, 3)`` metres of the camera in any fixed frame; None if `observe` is given the
                position of each frame.
            first_m: Length of the measured path that is used, in metres, from its start; the scale is not
                known before the odometry has measured this length.

        Raises:
            UsageError: The arrays do not fit together, or the length is not above 0.
        """
        if not first_m > 0:
            raise UsageError(f"first_m = {first_m:g} is not above 0", hint="leave first_m out to get 1 m")
        if (timestamps_s is None) != (positions_m is None) or (
            timestamps_s is not None
            and positions_m is not None
            and positions_m.shape != (len(timestamps_s), 3)
        ):
            shapes = [None if array is None else np.shape(array) for array in (timestamps_s, positions_m)]
            raise UsageError(
                f"time stamps of shape {shapes[0]} and positions of shape {shapes[1]} of odometry do not fit",
                hint="give one position for each stamp",
            )
        self.name = f"the first {first_m:g} m of odometry"
        self._first_m = first_m
        self._recorded_s = None if timestamps_s is None else np.asarray(timestamps_s, dtype=np.float64)
        self._recorded_m = None if positions_m is None else np.asarray(positions_m, dtype=np.float64)
        self._positions_m: dict[float, Array] = {}

    def observe(self, timestamp_s: float, rgb: npt.NDArray[np.uint8], position_m: Array | None) -> None:
        """Store the position of one frame; a frame without a position is ignored.

        Args:
            timestamp_s: Time of the frame, in seconds.
            rgb: The image, which is not used.
            position_m: ``(3,)`` metres; for None the nearest recorded position within 0.05 s is taken, if
                there is one.
        """
        if position_m is None and self._recorded_s is not None and self._recorded_m is not None:
            nearest = int(np.argmin(np.abs(self._recorded_s - timestamp_s)))
            if abs(self._recorded_s[nearest] - timestamp_s) <= _MAX_STAMP_DIFFERENCE_S:
                position_m = self._recorded_m[nearest]
        if position_m is not None:
            self._positions_m[_stamp_key(timestamp_s)] = np.asarray(position_m, dtype=np.float64)

    def is_due(self, timestamp_s: float, *, is_known: bool) -> bool:
        """Return whether the scale should be computed at a frame: only while it is not known (*is_known*)."""
        return not is_known

    def metres_per_unit(
        self, timestamps_s: Array, T_world_camera: Array, camera: Camera, depth: float
    ) -> float | None:
        """Return metres per unit of the map; None while the odometry does not determine it.

        The odometry must have measured *first_m* metres since the first pose that has a position, and have a
        position for five poses or more.

        Args:
            timestamps_s: ``(n,)`` seconds, times of the tracked poses, ascending.
            T_world_camera: ``(n, 4, 4)``, tracked poses in the unit of the map.
            camera: Intrinsics, not used.
            depth: Median depth of the map, not used.

        Source:
            Horn, JOSA A 1987, Sect. 2.E (scale without rotation).
        """
        rows = [n for n, stamp_s in enumerate(timestamps_s) if _stamp_key(stamp_s) in self._positions_m]
        if len(rows) < _MIN_ODOMETRY_FRAMES:
            return None
        measured_m = np.array([self._positions_m[_stamp_key(timestamps_s[n])] for n in rows])
        steps_m = np.linalg.norm(np.diff(measured_m, axis=0), axis=1)
        path_m = np.concatenate(([0.0], np.cumsum(steps_m)))
        if path_m[-1] < self._first_m:
            return None
        end = max(int(np.searchsorted(path_m, self._first_m)) + 1, _MIN_ODOMETRY_FRAMES)
        spread_m = _spread(measured_m[:end])
        spread = _spread(T_world_camera[rows[:end], :3, 3])
        return spread_m / spread if spread > 0 and spread_m > 0 else None


class MarkerScale:
    """Metric scale by square ArUco markers (dictionary 4x4_50) of one size that several frames show.

    ``name`` describes the source of the scale in reports.
    """

    def __init__(self, size_m: float) -> None:
        """Look for markers whose black square is *size_m* metres wide.

        Raises:
            UsageError: The size is not within 5 mm to 5 m.
        """
        if not _MIN_MARKER_M <= size_m <= _MAX_MARKER_M:
            raise UsageError(
                f"a marker of {1000 * size_m:g} mm is not within 5..5000 mm",
                hint="measure the black square, in millimetres",
            )
        self.name = f"a marker of {1000 * size_m:g} mm"
        self._size_m = size_m
        self._corners: defaultdict[int, dict[float, Array]] = defaultdict(dict)
        """Corners ``(4, 2)`` in pixels, by the marker's identity and the time of the frame."""

    def observe(self, timestamp_s: float, rgb: npt.NDArray[np.uint8], position_m: Array | None) -> None:
        """Detect the markers in one image, and store their corners.

        Args:
            timestamp_s: Time of the frame, in seconds.
            rgb: ``(h, w, 3)`` uint8, undistorted, red first.
            position_m: Position of the frame, which is not used.

        Raises:
            MissingExtra: OpenCV is not installed.
        """
        cv2 = load_opencv()
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        all_corners, identities, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(
            cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        )
        identities = () if identities is None else identities.ravel()
        for corners, identity in zip(all_corners, identities, strict=True):
            views = self._corners[int(identity)]
            views[_stamp_key(timestamp_s)] = corners.reshape(4, 2).astype(np.float64)

    def is_due(self, timestamp_s: float, *, is_known: bool) -> bool:
        """Return whether the scale should be computed at a frame: only while it is not known (*is_known*)."""
        return not is_known

    def metres_per_unit(
        self, timestamps_s: Array, T_world_camera: Array, camera: Camera, depth: float
    ) -> float | None:
        """Return metres per unit of the map by the marker with the largest parallax; None without one.

        Args:
            timestamps_s: ``(n,)`` seconds, times of the tracked poses.
            T_world_camera: ``(n, 4, 4)``, tracked poses in the unit of the map.
            camera: Intrinsics.
            depth: Median depth of the map, not used.
        """
        measured = [
            self._measure(views, timestamps_s, T_world_camera, camera) for views in self._corners.values()
        ]
        scales = [parallax_and_scale for parallax_and_scale in measured if parallax_and_scale is not None]
        return max(scales)[1] if scales else None

    def _measure(
        self, views: dict[float, Array], timestamps_s: Array, T_world_camera: Array, camera: Camera
    ) -> tuple[float, float] | None:
        """Return parallax in degrees and metres per unit of one marker; None if it does not determine them.

        *views* are its corners by time.
        """
        rows = [n for n, stamp_s in enumerate(timestamps_s) if _stamp_key(stamp_s) in views]
        if len(rows) < _MIN_MARKER_VIEWS:
            return None
        # 1. Triangulate the corners from the first view and the one farthest from it.
        poses = np.stack([inverse(T_world_camera[n]) for n in rows])
        corners = np.stack([views[_stamp_key(timestamps_s[n])] for n in rows])
        centres = T_world_camera[rows, :3, 3]
        farthest = int(np.argmax(np.linalg.norm(centres - centres[0], axis=1)))
        points, is_good = triangulate(
            poses[0],
            poses[farthest],
            corners[0],
            corners[farthest],
            camera,
            max_error_px=_MAX_CORNER_ERROR_PX,
        )
        if not is_good.all():
            return None
        angle_deg = float(parallax_deg(points, centres[0], centres[farthest]).mean())
        if angle_deg < _MIN_MARKER_PARALLAX_DEG:
            return None
        # 2. Adjust the corners to all views, whose poses are fixed.
        count = len(rows)
        bundle = Bundle(
            T_camera_world=poses,
            is_fixed=np.ones(count, dtype=bool),
            points_world=points,
            cameras=np.repeat(np.arange(count), 4),
            points=np.tile(np.arange(4), count),
            pixels=corners.reshape(-1, 2),
            sigma_px=np.full(4 * count, _CORNER_SIGMA_PX),
        )
        _, points = adjust(bundle, camera)
        # 3. Compare the edges with the marker's width, if they are those of a square.
        edges = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        if edges.max() > _MAX_EDGE_RATIO * edges.min():
            return None
        return angle_deg, self._size_m / float(edges.mean())


def _stamp_key(timestamp_s: float) -> float:
    return round(float(timestamp_s), _STAMP_DIGITS)


def _spread(positions: Array) -> float:
    """Return the root of the sum of squared distances of ``(n, 3)`` positions from their mean."""
    return float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum()))

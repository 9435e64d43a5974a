"""Call the PnP solver of the native core: from correspondences to a pose with its evidence in one C++ call.

``native/include/rse_pf_native.h`` describes the C interface, whose structs are packed here by hand: a
``ctypes.Structure`` would take longer than the call itself needs for few correspondences.  Equal requests
give equal bytes.
"""

from __future__ import annotations

import ctypes
import struct
import threading
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, DegenerateGeometry, NoConsensus, RsePfError
from rse_pf.geometry import Array, Camera
from rse_pf.native import PART_ABIS, address_of, aligned, load_core, load_part

__all__ = [
    "MIN_WIDTH_TO_LENGTH",
    "AcceptedPose",
    "Evidence",
    "NativeOptions",
    "NativeSolver",
    "native_solver",
    "open_solver",
]

MIN_WIDTH_TO_LENGTH = 0.02
"""Smallest width over length of the inlier pixels of an accepted pose; 0 is a line.

Length and width are 80 % quantiles: length of the distances from the centroid along the main axis of the
pixels, width of the distances from this axis.  The native core applies this limit (``kCollinear`` in
``native/src/solve.hpp``); here the value only appears in error messages and in `rse_pf.pnp.rules`.
"""

_FLAGS = {"avx512": 0, "avx2": 4, "portable": 1}
"""Flag of a request by the widest vector instructions that the core may use for it; a processor without them
uses narrower ones.  The choice changes the time only, no byte of the result."""

# --- Layout of the C struct rse_pf_pnp_request ---
_HEAD = struct.Struct("=IIq")  # version of the C interface, flags, number of correspondences
_ARRAYS = struct.Struct("=QQ")  # addresses of points_world and pixels
_POINTER = struct.Struct("=Q")  # address of T_camera_world; 0: estimate a pose
_BODY = struct.Struct("=Qddddiiddiidddd")  # T_camera_world, then intrinsics, image size and options
_BODY_AT = _HEAD.size + _ARRAYS.size  # byte offset of _BODY, and of _POINTER, its first field
_REQUEST_BYTES = _BODY_AT + _BODY.size

# --- Layout of the C struct rse_pf_pnp_result ---
_RESULT = struct.Struct("=iiqqqdddddd")  # the fields of _ResultHead
_POSE_AT = _RESULT.size  # byte offset of T_camera_world
_COVARIANCE_AT = _POSE_AT + 16 * 8  # byte offset of covariance
_UPPER_AT = _COVARIANCE_AT + 36 * 8  # byte offset of upper_triangle
_RESULT_BYTES = _UPPER_AT + 22 * 4

# --- Layout of the C struct rse_pf_lists ---
_LISTS_HEAD = struct.Struct("=Qq")  # address of the array ``numbers``, and its length
_LIST_ENDS = struct.Struct("=qqqq")  # number of lists, then for each of three lists the end of its numbers
_REST_AT = _LISTS_HEAD.size + _LIST_ENDS.size  # byte offset of ``rest``, the JSON text without its lists
# Most bytes of a JSON text besides its lists: RSE_PF_MAX_REST of the C header.  Of a text with more bytes,
# `NativeSolver.cut_lists` cuts no list, and the JSON parser reads the whole text, which takes longer.
_MAX_REST_BYTES = 1024

# Correspondences for which the arrays of a thread have room at first; a longer request enlarges the arrays.
_FIRST_ROWS = 512
# Most numbers in all lists of one JSON text: 5,000 correspondences of a point (3 numbers), a pixel (2) and a
# depth (1).  A text with more numbers is not refused: `NativeSolver.cut_lists` cuts no list of it, and the
# JSON parser reads the whole text, which takes longer.
_MAX_NUMBERS = 30_000

_REASONS = (
    "",
    "few-inliers",
    "low-inlier-ratio",
    "nearly-collinear",
    "clustered",
    "poorly-constrained",
    "ambiguous",
)
"""Reasons why a pose is weak, by the number of ``enum rse_pf_pnp_reason``; empty for a pose that is not
weak."""

_EVERYWHERE = "match points all over the image, or skip this frame"
_REFUSALS: dict[int, tuple[type[RsePfError], str, str]] = {
    2: (
        BadRequest,
        "points_world holds a number that is not finite or is beyond 1e+06",
        "leave such rows out",
    ),
    3: (
        BadRequest,
        "pixels holds a number that is not finite or is beyond 1e+06",
        "leave such rows out",
    ),
    4: (
        NoConsensus,
        "the best pose agrees with {inliers} of {rows} correspondences within {inlier_px:g} px, "
        "no more than chance would give",
        "tighten the matcher, or skip this frame",
    ),
    5: (
        DegenerateGeometry,
        "the points that agree lie on one line or coincide (width/length {width_to_length:.3f} is below "
        "{min_width_to_length})",
        _EVERYWHERE,
    ),
    6: (
        DegenerateGeometry,
        "the {inliers} correspondences that agree lie in {independent_inliers} places of the image, "
        "and may be copies of each other",
        _EVERYWHERE,
    ),
    7: (
        DegenerateGeometry,
        "the pixels that agree lie {radius_px:.1f} px (rms) from their centre, less than {inlier_px:g} px",
        _EVERYWHERE,
    ),
    8: (
        DegenerateGeometry,
        "the correspondences do not constrain some motion of the camera",
        "match more of the scene",
    ),
    9: (
        DegenerateGeometry,
        "two poses fit alike ({rmse_px:.2f} and {second_pose_rmse_px:.2f} px)",
        "match points that do not lie in one far plane",
    ),
    10: (
        DegenerateGeometry,
        "{mirrored_inliers} points agree behind the camera or mirrored, and only {inliers} as they are",
        "check the handedness of the world frame and the sign of the depth",
    ),
    11: (
        BadRequest,
        "no memory for {rows} correspondences",
        "send the best matches only",
    ),
}
"""Error class, message and hint for each status of ``enum rse_pf_pnp_status`` that refuses a pose, except
status 1, whose error is `_BAD_REQUEST`.

The messages are part of the replies to robots.  A changed message would make recordings of earlier releases
differ from their replay, which is compared byte by byte.  Therefore the terms that they leave open are
explained here: to agree means to be an inlier.  Status 4: at least 1e-5 random poses are expected to fit as
well (`Evidence.log10_false_alarms`).  Status 6: this holds only if inliers close together count once
(`Evidence.independent_inliers`).  Status 9: for the second pose of a planar scene, the sum of squared errors
is less than 9 pixel variances larger.  Status 10: a pose of the reflected points has at least twice as many
inliers.
"""
_BAD_REQUEST = (BadRequest, "the options or sizes of the request do not fit", "leave the options out")
_STATUSES_WITHOUT_EVIDENCE = (1, 2, 3, 11)
"""Statuses of requests that the core refuses before it computes anything: bad sizes or options (1), points
(2) or pixels (3), and no memory (11)."""


class NativeOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of the native solver, and the limits beyond which a pose is weak.

    Attributes:
        lanes: Widest vector instructions that the core may use; the choice changes no byte of a result.

    The other fields are those of `rse_pf.pnp.PnpOptions` and, with the prefix ``weak_``, of
    `rse_pf.pnp.WeakLimits`.  A ``min_iterations`` above ``max_iterations`` counts as ``max_iterations``.
    """

    inlier_px: float
    confidence: float
    max_iterations: int
    min_iterations: int
    weak_inliers: float
    weak_inlier_ratio: float
    weak_translation_m: float
    weak_rotation_rad: float
    lanes: Literal["avx512", "avx2", "portable"] = "avx512"


class Evidence(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A camera pose with the measurements by which it is accepted, called weak, or refused.

    A pose with fewer than four inliers is refused; only its matrix, its inliers and ``width_to_length`` are
    then measured, and the other numbers are 0.

    Attributes:
        T_camera_world: ``(4, 4)``, maps world points (metres) to the camera frame; zeros if the core was to
            estimate a pose and found none.
        inliers: Ascending row numbers of the inliers.
        rmse_px: Root mean square reprojection error of the inliers.
        covariance: ``(6, 6)`` of the twist (metres, radians) that multiplies the pose on the left; not finite
            or without a positive diagonal if the inliers do not constrain the pose.
        reason: Why the pose is weak, such as ``few-inliers``; empty for a pose that is not.  A refused pose
            may have a reason too.
        independent_inliers: Number of inliers of which those close together in the image count once, because
            they may be copies of one wrong match.  The image is divided into square cells, 40 across its
            width; an occupied cell counts unless it touches, also diagonally, a cell that was counted before
            it.  If 24 cells or more are occupied, the number of all inliers: copies of a few matches occupy
            fewer cells.
        log10_false_alarms: log10 of the expected number of wrong poses, computed by P3P from three random
            correspondences, that have at least as many independent inliers within the largest reprojection
            error of an inlier of this pose (number of false alarms of a-contrario RANSAC).
        width_to_length: Width over length, defined at `MIN_WIDTH_TO_LENGTH`, on which the rule about
            collinear matches decided.  If the pose has fewer than four inliers, or a random pose would have
            as many: that of all 3-D points, or of all pixels where the points are not collinear and the
            pixels are narrower.  0 if the inliers may be copies of each other.  Else that of the inlier
            pixels.
        inlier_width_to_length: Width over length of the inlier pixels; 0 is a line.  Above 0.15 it may be a
            lower bound.
        radius_px: Root mean square distance of the inlier pixels from their centroid.
        second_pose_rmse_px: Root mean square reprojection error of the same inliers by the second pose of a
            planar scene; 0 without a second pose.
        refusal: Error of the first rule that refuses the pose; None for an accepted pose.
    """

    T_camera_world: Array
    inliers: npt.NDArray[np.intp]
    rmse_px: float
    covariance: Array
    reason: str
    independent_inliers: int
    log10_false_alarms: float
    width_to_length: float
    inlier_width_to_length: float
    radius_px: float
    second_pose_rmse_px: float
    refusal: RsePfError | None


class AcceptedPose(NamedTuple):
    """A pose that no rule refuses, in the arrays of a ``pnp`` reply.

    Attributes:
        T_camera_world: ``(16,)``, a row-major 4x4 matrix.
        inliers: Ascending row numbers of the inliers, uint32.
        rmse_px: Root mean square reprojection error of the inliers.
        covariance: ``(21,)`` float32, the upper triangle by rows of the ``(6, 6)`` covariance of the twist
            (metres, radians) that multiplies the pose on the left.
        reason: Why the pose is weak; empty for a pose that is not.
    """

    T_camera_world: Array
    inliers: npt.NDArray[np.uint32]
    rmse_px: float
    covariance: npt.NDArray[np.float32]
    reason: str


class _ResultHead(NamedTuple):
    """The numbers of rse_pf_pnp_result in the order of the C struct; ``inliers`` is its ``inlier_count``."""

    status: int
    reason: int
    inliers: int
    independent_inliers: int
    mirrored_inliers: int
    rmse_px: float
    second_pose_rmse_px: float
    width_to_length: float
    radius_px: float
    inlier_width_to_length: float
    log10_false_alarms: float


class _Buffers(threading.local):
    """Request, result and arrays of one thread, whose memory addresses are computed once.

    A call copies its points and pixels into these arrays: to ask numpy for the memory addresses of the
    caller's arrays would take longer than the copies.
    """

    def __init__(self) -> None:
        request, result = np.zeros(_REQUEST_BYTES, dtype=np.uint8), np.zeros(_RESULT_BYTES, dtype=np.uint8)
        self.request = memoryview(request)  # type: ignore[arg-type]
        self.result = memoryview(result)  # type: ignore[arg-type]
        self.request_address, self.result_address = address_of(request), address_of(result)
        self.pose = result[_POSE_AT:_COVARIANCE_AT].view(np.float64)
        self.covariance = result[_COVARIANCE_AT:_UPPER_AT].view(np.float64).reshape(6, 6)
        self.upper_triangle = result[_UPPER_AT:].view(np.float32)[:21]
        self.allocate(_FIRST_ROWS)

    def allocate(self, rows: int) -> None:
        """Replace the arrays by uninitialised ones for *rows* correspondences, and write their addresses."""
        points_world, pixels = np.empty(3 * rows), np.empty(2 * rows)
        inliers = np.empty(rows, dtype=np.uint32)
        # Write the addresses after all allocations: if one fails, the request keeps those of the old arrays.
        _ARRAYS.pack_into(self.request, _HEAD.size, address_of(points_world), address_of(pixels))
        self.points_world, self.pixels = points_world, pixels
        self.inliers, self.inliers_address, self.rows = inliers, address_of(inliers), rows


class _ListBuffers(threading.local):
    """The C struct rse_pf_lists of one thread, with memory for the numbers of a JSON text."""

    def __init__(self) -> None:
        self.numbers = np.empty(_MAX_NUMBERS)
        lists = np.zeros(_REST_AT + _MAX_REST_BYTES, dtype=np.uint8)
        self.lists = memoryview(lists)  # type: ignore[arg-type]
        self.lists_address = address_of(lists)
        self.rest = self.lists[_REST_AT:]
        _LISTS_HEAD.pack_into(self.lists, 0, address_of(self.numbers), _MAX_NUMBERS)


@lru_cache(maxsize=256)
def _pack_body(camera: Camera, options: NativeOptions) -> bytes:
    return _BODY.pack(
        0,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        camera.width,
        camera.height,
        options.inlier_px,
        options.confidence,
        options.max_iterations,
        min(options.min_iterations, options.max_iterations),
        options.weak_inliers,
        options.weak_inlier_ratio,
        options.weak_translation_m,
        options.weak_rotation_rad,
    )


class NativeSolver:
    """The PnP solver of one loaded library; any thread may call it, and each thread has its own buffers."""

    def __init__(
        self,
        solve_function: Callable[[int, int, int], None],
        cut_function: Callable[[bytes, int, int], int],
        lanes: str,
    ) -> None:
        self._solve_function, self._cut_function = solve_function, cut_function
        self._buffers, self._lists = _Buffers(), _ListBuffers()
        self.lanes = lanes
        """Widest vector instructions that the core uses on this processor: ``avx512``, ``avx2`` or
        ``portable``."""

    def solve(
        self, points_world: Array, pixels: Array, camera: Camera, options: NativeOptions
    ) -> AcceptedPose:
        """Estimate a camera pose, and raise an error if a rule refuses it.

        Args:
            points_world: ``(3n,)`` or ``(n, 3)``, metres, world frame; ``n >= 4``.
            pixels: ``(2n,)`` or ``(n, 2)``, undistorted pixels.
            camera: Intrinsics of the image that the pixels come from.
            options: Options of RANSAC, and limits of weak poses.

        Returns:
            The pose, which may be weak, in new arrays.

        Raises:
            BadRequest: Sizes or options do not fit, ``n < 4``, a number is not finite or beyond 1e6, or
                memory is short.
            NoConsensus: No pose has more inliers than a random pose would have.
            DegenerateGeometry: The inliers do not determine one pose.
        """
        result, inliers = self._call(points_world, pixels, camera, options, None)
        if result[0]:
            raise _solver_error(_ResultHead(*result), pixels.size // 2, options)
        buffers = self._buffers
        return AcceptedPose(
            buffers.pose.copy(), inliers, result[5], buffers.upper_triangle.copy(), _REASONS[result[1]]
        )

    def evaluate(
        self,
        points_world: Array,
        pixels: Array,
        camera: Camera,
        options: NativeOptions,
        T_camera_world: Array | None = None,
    ) -> Evidence:
        """Estimate a camera pose, or take a given one, and measure its evidence.

        A pose that a rule refuses is returned as well, with the error as its ``refusal``.

        Args:
            points_world: As in `solve`.
            pixels: As in `solve`.
            camera: As in `solve`.
            options: As in `solve`.
            T_camera_world: ``(4, 4)``, the pose whose evidence is wanted, which is not refined; None to
                estimate a pose.

        Raises:
            BadRequest: Sizes or options do not fit, ``n < 4``, a number is not finite or beyond 1e6, or
                memory is short.
        """
        pose = None if T_camera_world is None else aligned(T_camera_world, np.float64)
        if pose is not None and pose.shape != (4, 4):
            raise BadRequest(f"the pose {pose.shape} is not (4, 4)", hint="give T_camera_world")
        numbers, inliers = self._call(points_world, pixels, camera, options, pose)
        result = _ResultHead(*numbers)
        refusal = _solver_error(result, pixels.size // 2, options) if result.status else None
        if refusal is not None and result.status in _STATUSES_WITHOUT_EVIDENCE:
            raise refusal
        buffers = self._buffers
        return Evidence(
            T_camera_world=buffers.pose.reshape(4, 4).copy() if pose is None else pose,
            inliers=inliers.astype(np.intp),
            rmse_px=result.rmse_px,
            covariance=buffers.covariance.copy(),
            reason=_REASONS[result.reason],
            independent_inliers=result.independent_inliers,
            log10_false_alarms=result.log10_false_alarms,
            width_to_length=result.width_to_length,
            inlier_width_to_length=result.inlier_width_to_length,
            radius_px=result.radius_px,
            second_pose_rmse_px=result.second_pose_rmse_px,
            refusal=refusal,
        )

    def _call(
        self, points_world: Array, pixels: Array, camera: Camera, options: NativeOptions, pose: Array | None
    ) -> tuple[tuple[Any, ...], npt.NDArray[np.uint32]]:
        """Call the core; return the numbers of `_ResultHead`, and a copy of the row numbers of the inliers.

        Pose and covariance stay in the buffers until the next call of this thread.  If *pose* is None, the
        core estimates a pose; otherwise it measures the evidence of *pose*, ``(4, 4)``.
        """
        n = pixels.size // 2
        if points_world.size != 3 * n or pixels.size != 2 * n:
            raise BadRequest(
                f"points {points_world.shape} and pixels {pixels.shape} are not (n, 3) and (n, 2)",
                hint="send one pixel for each point",
            )
        buffers = self._buffers
        if n > buffers.rows:
            buffers.allocate(n)
        buffers.points_world[: 3 * n] = points_world if points_world.ndim == 1 else points_world.reshape(-1)
        buffers.pixels[: 2 * n] = pixels if pixels.ndim == 1 else pixels.reshape(-1)
        _HEAD.pack_into(buffers.request, 0, PART_ABIS["native"], _FLAGS[options.lanes], n)
        buffers.request[_BODY_AT:] = _pack_body(camera, options)
        if pose is not None:
            _POINTER.pack_into(buffers.request, _BODY_AT, address_of(pose))
        self._solve_function(buffers.request_address, buffers.inliers_address, buffers.result_address)
        result = _RESULT.unpack_from(buffers.result)
        return result, buffers.inliers[: result[2]].copy()

    def cut_lists(self, text: bytes) -> tuple[memoryview, list[Array]] | None:
        """Move the lists of numbers out of a JSON text, so that a JSON parser makes no object of each number.

        Returns:
            A view of the text in which the JSON string ``"\\u000K"`` replaces the list with the number K (0,
            1 or 2, by position in the text), and the lists as new float64 arrays.  The next call of this
            thread overwrites the view, but not the arrays.  None if the text must be parsed as usual: it has
            more than three lists, more than 30,000 numbers in them, or a list that is empty or holds anything
            but numbers; a number is ``-0``, or has more than 15 digits or an exponent; the text has a
            backslash, or more than 1,024 bytes besides the lists.  Such a text is not refused here.
        """
        buffers = self._lists
        size = self._cut_function(text, len(text), buffers.lists_address)
        if size < 0:
            return None
        count, *ends = _LIST_ENDS.unpack_from(buffers.lists, _LISTS_HEAD.size)
        numbers = buffers.numbers[: ends[count - 1]].copy()
        starts = (0, *ends)
        return buffers.rest[:size], [numbers[starts[i] : ends[i]] for i in range(count)]


def _solver_error(result: _ResultHead, rows: int, options: NativeOptions) -> RsePfError:
    kind, message, hint = _REFUSALS.get(result.status, _BAD_REQUEST)
    values = {
        **result._asdict(),
        "rows": rows,
        "inlier_px": options.inlier_px,
        "min_width_to_length": MIN_WIDTH_TO_LENGTH,
    }
    return kind(message.format_map(values), hint=hint)


def open_solver(path: Path) -> NativeSolver:
    """Load the PnP solver of the library at *path*.

    Raises:
        ConfigurationError: The library cannot be loaded, or has another version.
    """
    solve, cut, lanes = load_part(
        path, "native", PART_ABIS["native"], "rse_pf_pnp_solve", "rse_pf_cut_lists", "rse_pf_native_lanes"
    )
    lanes.restype = ctypes.c_char_p
    cut.argtypes, cut.restype = (ctypes.c_char_p, ctypes.c_int64, ctypes.c_void_p), ctypes.c_int64
    solve.argtypes, solve.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p), None
    return NativeSolver(solve, cut, lanes().decode())


@cache
def native_solver() -> NativeSolver:
    """Return the PnP solver of the installed native core, which is loaded once in a process.

    Raises:
        MissingExtra: The native core is not installed.
        ConfigurationError: The native core cannot be loaded, or has another version.
    """
    return load_core(open_solver)

"""The native core: the whole PnP solver with its evidence in one call into a shared library.

The library is loaded at first use, and is required wherever poses or features are computed.  Nothing here
compiles or installs it: ``native/README.md`` says how.  A call holds no interpreter lock, and equal requests
give equal bytes.
"""

from __future__ import annotations

import ctypes
import struct
import threading
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import (
    BadRequest,
    ConfigurationError,
    DegenerateGeometry,
    MissingExtra,
    NoConsensus,
    RsePfError,
)
from rse_pf.geometry import Array, Camera

__all__ = [
    "COLLINEAR",
    "PART_ABIS",
    "Evidence",
    "NativeOptions",
    "NativeSolver",
    "Workspace",
    "address_of",
    "aligned",
    "core_function",
    "find_library",
    "load_core",
    "load_part",
    "native_solver",
    "open_solver",
]

Part = TypeVar("Part")

_ABI = 4
PART_ABIS = {"check": 2, "cloud": 1, "depth": 1, "match": 4, "stereo": 1, "track": 2}
"""The version of each header ``rse_pf_PART.h`` that this package calls."""
_FILE = "librse_pf_native.so"
_LANES = {"avx512": 0, "avx2": 4, "portable": 1}
# rse_pf_pnp_request: abi, flags, rows, points, pixels, pose | camera, options.
_HEAD = struct.Struct("=IIqQQQ")
_BODY = struct.Struct("=ddddiiddiidddd")
# rse_pf_pnp_result: status, reason, three counts, six measures | pose | covariance.
_RESULT = struct.Struct("=iiqqqdddddd")
_POSE_AT = _RESULT.size
_COVARIANCE_AT = _POSE_AT + 16 * 8
_RESULT_BYTES = _COVARIANCE_AT + 36 * 8
_STATUSES_WITHOUT_EVIDENCE = (1, 2, 3, 11)
COLLINEAR = 0.02  # width over length of matches below which no pose is given

_REASONS = (
    "", "few-inliers", "low-inlier-ratio", "nearly-collinear", "clustered", "poorly-constrained", "ambiguous",
)  # fmt: skip


class NativeOptions(msgspec.Struct, frozen=True, kw_only=True):
    """How the library solves, and where a pose stops being ok.

    ``lanes`` are the widest instructions allowed, which changes no byte; the other fields are those of
    `rse_pf.pnp.PnpOptions` and, with ``weak_`` before them, of `rse_pf.pnp.WeakLimits`.
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
    """A pose and its evidence; the first five fields are those of `rse_pf.pnp.PnpSolution`.

    Attributes:
        independent: How many inliers count as independent: neighbours in the image count once.
        log10_false_alarms: log10 of the expected number of random poses with such inliers.
        thinness: Width over length of all matches, in space or in the image, whichever is less; only where
            chance explains the pose.
        inlier_thinness: Width over length of the inliers in the image.
        radius_px: Root mean square distance of the inliers from their centre in the image.
        other_rmse_px: Of the second pose of a plane; 0 without a second pose.
        refusal: The error of the first rule that refuses the pose; None if it is accepted.
    """

    T_camera_world: Array
    inliers: npt.NDArray[np.intp]
    rmse_px: float
    covariance: Array
    reason: str
    independent: int
    log10_false_alarms: float
    thinness: float
    inlier_thinness: float
    radius_px: float
    other_rmse_px: float
    refusal: RsePfError | None


class _Buffers(threading.local):
    """The request and the result of one thread, with views of their parts."""

    def __init__(self) -> None:
        request = np.zeros(_HEAD.size + _BODY.size, dtype=np.uint8)
        result = np.zeros(_RESULT_BYTES, dtype=np.uint8)
        self.request = memoryview(request)  # type: ignore[arg-type]
        self.result = memoryview(result)  # type: ignore[arg-type]
        self.request_at, self.result_at = address_of(request), address_of(result)
        self.pose = result[_POSE_AT:_COVARIANCE_AT].view(np.float64).reshape(4, 4)
        self.covariance = result[_COVARIANCE_AT:].view(np.float64).reshape(6, 6)


@lru_cache(maxsize=256)
def _pack(camera: Camera, options: NativeOptions) -> bytes:
    return _BODY.pack(
        camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height,
        options.inlier_px, options.confidence, options.max_iterations,
        min(options.min_iterations, options.max_iterations),
        options.weak_inliers, options.weak_inlier_ratio, options.weak_translation_m,
        options.weak_rotation_rad,
    )  # fmt: skip


class NativeSolver:
    """The solver of one loaded library; every thread may call it."""

    def __init__(self, call: Callable[[int, int, int], None], lanes: str) -> None:
        self._call = call
        self._buffers = _Buffers()
        self.lanes = lanes
        """``avx512``, ``avx2`` or ``portable``: the instructions that this processor gets."""

    def judge(
        self,
        points_world: Array,
        pixels: Array,
        camera: Camera,
        options: NativeOptions,
        T_camera_world: Array | None = None,
    ) -> Evidence:
        """Return a camera pose with its evidence, also where a rule refuses the pose.

        Args:
            points_world: ``(n, 3)``, metres, world frame; ``n >= 4``.
            pixels: ``(n, 2)``, undistorted pixels.
            camera: Intrinsics of the image the pixels come from.
            options: How to solve.
            T_camera_world: The ``(4, 4)`` pose to judge; None to estimate the pose.

        Raises:
            BadRequest: Shapes do not fit, or a number is not finite or absurd.
        """
        # The library trusts these: what is not contiguous, not aligned or not float64 is copied.
        points_world, pixels = aligned(points_world, np.float64), aligned(pixels, np.float64)
        n = len(pixels)
        if points_world.shape != (n, 3) or pixels.shape != (n, 2):
            raise BadRequest(
                f"points {points_world.shape} and pixels {pixels.shape} are not (n, 3) and (n, 2)",
                hint="send one pixel for each point",
            )
        pose = None if T_camera_world is None else aligned(T_camera_world, np.float64)
        if pose is not None and pose.shape != (4, 4):
            raise BadRequest(f"the pose {pose.shape} is not (4, 4)", hint="give T_camera_world")
        inliers = np.empty(n, dtype=np.int64)
        buffers = self._buffers
        _HEAD.pack_into(
            buffers.request, 0, _ABI, _LANES[options.lanes], n, address_of(points_world), address_of(pixels),
            0 if pose is None else address_of(pose),
        )  # fmt: skip
        buffers.request[_HEAD.size : _HEAD.size + _BODY.size] = _pack(camera, options)
        self._call(buffers.request_at, address_of(inliers), buffers.result_at)
        values = _RESULT.unpack_from(buffers.result)
        status, reason, count, independent, _, rmse, other_rmse, thinness, radius, inlier_thinness, chance = (
            values
        )
        refusal = _solver_error(values, n, options) if status else None
        if refusal is not None and status in _STATUSES_WITHOUT_EVIDENCE:
            raise refusal
        return Evidence(
            T_camera_world=buffers.pose.copy() if pose is None else pose,
            inliers=inliers[:count],
            rmse_px=rmse,
            covariance=buffers.covariance.copy(),
            reason=_REASONS[reason],
            independent=independent,
            log10_false_alarms=chance,
            thinness=thinness,
            inlier_thinness=inlier_thinness,
            radius_px=radius,
            other_rmse_px=other_rmse,
            refusal=refusal,
        )


def _solver_error(values: tuple[Any, ...], n: int, options: NativeOptions) -> RsePfError:
    """Return the error of a status other than 0."""
    status, _, count, independent, other, rmse_px, other_rmse_px, thinness, radius_px, *_ = values
    everywhere = "match points all over the image, or skip this frame"
    match status:
        case 2 | 3:
            return BadRequest(
                f"{'points_world' if status == 2 else 'pixels'} holds a number that is not finite or is "
                "beyond 1e+06",
                hint="leave such rows out",
            )
        case 4:
            return NoConsensus(
                f"the best pose agrees with {count} of {n} correspondences within "
                f"{options.inlier_px:g} px, no more than chance would give",
                hint="tighten the matcher, or skip this frame",
            )
        case 5:
            return DegenerateGeometry(
                f"the points that agree lie on one line or coincide (width/length {thinness:.3f} is below "
                f"{COLLINEAR})",
                hint=everywhere,
            )
        case 6:
            return DegenerateGeometry(
                f"the {count} correspondences that agree lie in {independent} places of the image, "
                "and may be copies of each other",
                hint=everywhere,
            )
        case 7:
            return DegenerateGeometry(
                f"the pixels that agree lie {radius_px:.1f} px (rms) from their centre, "
                f"less than {options.inlier_px:g} px",
                hint=everywhere,
            )
        case 8:
            return DegenerateGeometry(
                "the correspondences do not constrain some motion of the camera",
                hint="match more of the scene",
            )
        case 9:
            return DegenerateGeometry(
                f"two poses fit alike ({rmse_px:.2f} and {other_rmse_px:.2f} px)",
                hint="match points that do not lie in one far plane",
            )
        case 10:
            return DegenerateGeometry(
                f"{other} points agree behind the camera or mirrored, and only {count} as they are",
                hint="check the handedness of the world frame and the sign of the depth",
            )
        case 11:
            return BadRequest(f"no memory for {n} correspondences", hint="send the best matches only")
    return BadRequest("the options or sizes of the request do not fit", hint="leave the options out")


def find_library() -> Path | None:
    """Return the library's file: that of the package ``rse_pf_native``, else that built in this checkout."""
    folders = [Path(__file__).parents[1] / "native" / "build"]
    installed = find_spec("rse_pf_native")
    if installed is not None and installed.origin:
        package = Path(installed.origin).parent
        folders = [package, package.parent / "build", *folders]  # the second: an editable installation
    return next((folder / _FILE for folder in folders if (folder / _FILE).is_file()), None)


def address_of(array: npt.NDArray[Any]) -> int:
    """Return where the first number of *array* lies in memory."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]
    except (TypeError, ValueError):  # read-only, with gaps or empty: numpy tells it, in ten times the time
        address: int = array.__array_interface__["data"][0]
        return address


def aligned(array: npt.NDArray[Any], dtype: type | None = None) -> npt.NDArray[Any]:
    """Return *array*, or a copy that is contiguous and aligned as C expects, and of *dtype*."""
    whole = np.ascontiguousarray(array, dtype=dtype)
    return whole if whole.flags.aligned else whole.copy()


class Workspace(threading.local):
    """Memory that a thread lends to the library, so that a call allocates no more than its results."""

    _words = np.empty(0, dtype=np.uint64)

    def words(self, count: int) -> npt.NDArray[np.uint64]:
        """Return *count* numbers of 8 bytes or more, whose values are arbitrary."""
        if len(self._words) < count:
            self._words = np.empty(count, dtype=np.uint64)
        return self._words


def load_part(path: Path, part: str, abi: int, *functions: str) -> list[Any]:
    """Return *functions* of the library at *path*, once the version of their part was checked.

    Args:
        path: Of the library.
        part: ``native`` (the solver), ``depth``, ``match``, ``track`` or ``stereo``;
            ``rse_pf_PART_abi`` is its version.
        abi: The version that the caller needs.
        functions: Their names.

    Raises:
        ConfigurationError: It cannot be loaded, or was built for another version of this package.
    """
    again = "build it again: make native"
    try:
        library = ctypes.CDLL(str(path))
        version = library[f"rse_pf_{part}_abi"]
        loaded = [library[name] for name in functions]
    except (OSError, AttributeError) as error:
        raise ConfigurationError(f"{path} cannot be loaded: {error}", hint=again) from error
    version.restype = ctypes.c_uint32
    if version() != abi:
        raise ConfigurationError(f"{path} has the {part} ABI {version()}, not {abi}", hint=again)
    return loaded


def load_core(open_part: Callable[[Path], Part]) -> Part:
    """Return the part that *open_part* opens in the native core.

    Raises:
        MissingExtra: The native core is not installed.
        ConfigurationError: The native core cannot be loaded, or has another version.
    """
    path = find_library()
    if path is None:
        error = MissingExtra("the native core", "vision")
        error.hint = f"make native in a checkout; or pip install its folder native, then {error.hint}"
        raise error
    return open_part(path)


def core_function(part: str, name: str, arguments: Sequence[Any], result: Any) -> Any:
    """Return the function *name* of a part of the native core, with the types of its arguments and result.

    Raises:
        MissingExtra: The native core is not installed.
        ConfigurationError: The native core cannot be loaded, or has another version.
    """
    (function,) = load_core(lambda path: load_part(path, part, PART_ABIS[part], name))
    function.argtypes, function.restype = arguments, result
    return function


def open_solver(path: Path) -> NativeSolver:
    """Load the library at *path*; raises ConfigurationError as `load_part` says."""
    solve, lanes = load_part(path, "native", _ABI, "rse_pf_pnp_solve", "rse_pf_native_lanes")
    lanes.restype = ctypes.c_char_p
    solve.argtypes, solve.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p), None
    return NativeSolver(solve, lanes().decode())


@cache
def native_solver() -> NativeSolver:
    """Return the solver of the native core, which is required."""
    return load_core(open_solver)

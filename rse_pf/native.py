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
from typing import Any, Literal, NamedTuple, TypeVar

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

_ABI = 5
PART_ABIS = {"check": 2, "cloud": 1, "depth": 1, "match": 4, "stereo": 1, "track": 2}
"""The version of each header ``rse_pf_PART.h`` that this package calls."""
_FILE = "librse_pf_native.so"
_LANES = {"avx512": 0, "avx2": 4, "portable": 1}
# rse_pf_pnp_request: abi, flags, rows | points, pixels | pose | camera, options.
_HEAD = struct.Struct("=IIq")
_ARRAYS = struct.Struct("=QQ")
_POINTER = struct.Struct("=Q")
_BODY = struct.Struct("=Qddddiiddiidddd")
_BODY_AT = _HEAD.size + _ARRAYS.size
_REQUEST_BYTES = _BODY_AT + _BODY.size
_FIRST_ROWS = 512
# rse_pf_pnp_result: status, reason, three counts, six measures | pose | covariance | its upper triangle.
_RESULT = struct.Struct("=iiqqqdddddd")
_POSE_AT = _RESULT.size
_COVARIANCE_AT = _POSE_AT + 16 * 8
_UPPER_AT = _COVARIANCE_AT + 36 * 8
_RESULT_BYTES = _UPPER_AT + 22 * 4
# rse_pf_lists: numbers, room | count, ends | rest.
_FOUND = struct.Struct("=qqqq")
_FOUND_AT = 16
_MAX_REST_BYTES = 1024
_MAX_NUMBERS = 30_000  # of 5,000 matches with depths
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


class Pose(NamedTuple):
    """A pose that no rule refuses, in the arrays of a reply.

    Attributes:
        T_camera_world: ``(16,)``, row-major.
        inliers: Sorted row numbers, uint32.
        rmse_px: Root mean square reprojection error over the inliers.
        covariance: ``(21,)`` float32, the upper triangle of the ``(6, 6)`` covariance.
        reason: Why the pose is weak; empty for a pose that is ok.
    """

    T_camera_world: Array
    inliers: npt.NDArray[np.uint32]
    rmse_px: float
    covariance: npt.NDArray[np.float32]
    reason: str


class _Buffers(threading.local):
    """What one thread lends to the library; to look up the addresses of other arrays would take longer."""

    def __init__(self) -> None:
        request, result = np.zeros(_REQUEST_BYTES, dtype=np.uint8), np.zeros(_RESULT_BYTES, dtype=np.uint8)
        self.request = memoryview(request)  # type: ignore[arg-type]
        self.result = memoryview(result)  # type: ignore[arg-type]
        self.request_at, self.result_at = address_of(request), address_of(result)
        self.pose = result[_POSE_AT:_COVARIANCE_AT].view(np.float64)
        self.covariance = result[_COVARIANCE_AT:_UPPER_AT].view(np.float64).reshape(6, 6)
        self.upper = result[_UPPER_AT:].view(np.float32)[:21]
        self.hold(_FIRST_ROWS)

    def hold(self, rows: int) -> None:
        """Make room for *rows* points and pixels, and for as many inliers."""
        points_world, pixels = np.empty(3 * rows), np.empty(2 * rows)
        inliers = np.empty(rows, dtype=np.uint32)
        # Nothing from here on can fail for want of memory and leave the address of an array that is gone.
        _ARRAYS.pack_into(self.request, _HEAD.size, address_of(points_world), address_of(pixels))
        self.points_world, self.pixels = points_world, pixels
        self.inliers, self.inliers_at, self.rows = inliers, address_of(inliers), rows


class _Lists(threading.local):
    """What one thread lends to the library for the lists of numbers in a text."""

    def __init__(self) -> None:
        self.numbers = np.empty(_MAX_NUMBERS)
        lists = np.zeros(_FOUND_AT + _FOUND.size + _MAX_REST_BYTES, dtype=np.uint8)
        self.lists = memoryview(lists)  # type: ignore[arg-type]
        self.lists_at = address_of(lists)
        self.rest = self.lists[_FOUND_AT + _FOUND.size :]
        struct.pack_into("=Qq", self.lists, 0, address_of(self.numbers), _MAX_NUMBERS)


@lru_cache(maxsize=256)
def _pack(camera: Camera, options: NativeOptions) -> bytes:
    return _BODY.pack(
        0, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height,
        options.inlier_px, options.confidence, options.max_iterations,
        min(options.min_iterations, options.max_iterations),
        options.weak_inliers, options.weak_inlier_ratio, options.weak_translation_m,
        options.weak_rotation_rad,
    )  # fmt: skip


class NativeSolver:
    """The solver of one loaded library; every thread may call it."""

    def __init__(
        self,
        call: Callable[[int, int, int], None],
        cut: Callable[[bytes, int, int], int],
        lanes: str,
    ) -> None:
        self._call, self._cut = call, cut
        self._buffers, self._lists = _Buffers(), _Lists()
        self.lanes = lanes
        """``avx512``, ``avx2`` or ``portable``: the instructions that this processor gets."""

    def solve(self, points_world: Array, pixels: Array, camera: Camera, options: NativeOptions) -> Pose:
        """Return a camera pose that no rule refuses.

        Args:
            points_world: ``(3n,)`` or ``(n, 3)``, metres, world frame; ``n >= 4``.
            pixels: ``(2n,)`` or ``(n, 2)``, undistorted pixels.
            camera: Intrinsics of the image the pixels come from.
            options: How to solve.

        Raises:
            BadRequest: Sizes do not fit, or a number is not finite or absurd.
            NoConsensus: No pose agrees with more rows than chance would give.
            DegenerateGeometry: A rule refuses the pose.
        """
        values, inliers = self._solve(points_world, pixels, camera, options, None)
        if values[0]:
            raise _solver_error(values, pixels.size // 2, options)
        buffers = self._buffers
        return Pose(buffers.pose.copy(), inliers, values[5], buffers.upper.copy(), _REASONS[values[1]])

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
            points_world: As in `solve`.
            pixels: As in `solve`.
            camera: As in `solve`.
            options: As in `solve`.
            T_camera_world: The ``(4, 4)`` pose to judge; None to estimate the pose.

        Raises:
            BadRequest: Sizes do not fit, or a number is not finite or absurd.
        """
        pose = None if T_camera_world is None else aligned(T_camera_world, np.float64)
        if pose is not None and pose.shape != (4, 4):
            raise BadRequest(f"the pose {pose.shape} is not (4, 4)", hint="give T_camera_world")
        values, inliers = self._solve(points_world, pixels, camera, options, pose)
        status, reason, _, independent, _, rmse, other_rmse, thinness, radius, inlier_thinness, chance = (
            values
        )
        refusal = _solver_error(values, pixels.size // 2, options) if status else None
        if refusal is not None and status in _STATUSES_WITHOUT_EVIDENCE:
            raise refusal
        buffers = self._buffers
        return Evidence(
            T_camera_world=buffers.pose.reshape(4, 4).copy() if pose is None else pose,
            inliers=inliers.astype(np.intp),
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

    def _solve(
        self, points_world: Array, pixels: Array, camera: Camera, options: NativeOptions, pose: Array | None
    ) -> tuple[tuple[Any, ...], npt.NDArray[np.uint32]]:
        """Return the numbers of the result and the inliers; the arrays are in the buffers of the thread."""
        n = pixels.size // 2
        if points_world.size != 3 * n or pixels.size != 2 * n:
            raise BadRequest(
                f"points {points_world.shape} and pixels {pixels.shape} are not (n, 3) and (n, 2)",
                hint="send one pixel for each point",
            )
        buffers = self._buffers
        if n > buffers.rows:
            buffers.hold(n)
        buffers.points_world[: 3 * n] = points_world if points_world.ndim == 1 else points_world.reshape(-1)
        buffers.pixels[: 2 * n] = pixels if pixels.ndim == 1 else pixels.reshape(-1)
        _HEAD.pack_into(buffers.request, 0, _ABI, _LANES[options.lanes], n)
        buffers.request[_BODY_AT:] = _pack(camera, options)
        if pose is not None:
            _POINTER.pack_into(buffers.request, _BODY_AT, address_of(pose))
        self._call(buffers.request_at, buffers.inliers_at, buffers.result_at)
        values = _RESULT.unpack_from(buffers.result)
        return values, buffers.inliers[: values[2]].copy()

    def cut_lists(self, text: bytes) -> tuple[memoryview, list[Array]] | None:
        """Return the JSON *text* without its lists of numbers, and the lists.

        The string ``"\\u000K"`` takes the place of list K in the text, which is valid until the next call of
        this thread.  None means that the text is not read here: it has no lists, more than three, or others
        than of numbers, a number has more than 15 digits or an exponent, or a backslash is in it.
        """
        buffers = self._lists
        size = self._cut(text, len(text), buffers.lists_at)
        if size < 0:
            return None
        count, *ends = _FOUND.unpack_from(buffers.lists, _FOUND_AT)
        numbers = buffers.numbers[: ends[count - 1]].copy()
        starts = (0, *ends)
        return buffers.rest[:size], [numbers[starts[i] : ends[i]] for i in range(count)]


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
    if type(array) is np.ndarray and array.dtype.type is dtype and array.flags.carray:
        return array
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
    solve, cut, lanes = load_part(
        path, "native", _ABI, "rse_pf_pnp_solve", "rse_pf_cut_lists", "rse_pf_native_lanes"
    )
    lanes.restype = ctypes.c_char_p
    cut.argtypes, cut.restype = (ctypes.c_char_p, ctypes.c_int64, ctypes.c_void_p), ctypes.c_int64
    solve.argtypes, solve.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p), None
    return NativeSolver(solve, cut, lanes().decode())


@cache
def native_solver() -> NativeSolver:
    """Return the solver of the native core, which is required."""
    return load_core(open_solver)

"""Fuzz the native core's front end, depth refinement and tracker with any numbers and sizes.

Each target calls the library through the Python binding, and directly with buffers of the smallest size that
the C ABI allows.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import Frame, FrontEndOptions, points_at
from fuzz.checks import expect
from fuzz.meter import Meter
from rse_pf.errors import BadRequest, ProtocolError
from rse_pf.geometry import Array, Camera
from rse_pf.native import PART_ABIS, address_of, core_function
from rse_pf.pnp import DepthNoise, PnpSolution, refine_with_depth
from rse_pf.pnp.problems import KINECT
from rse_pf.slam.descriptors import match_orb, measure_distinctiveness
from rse_pf.slam.orb import Keypoints, describe_keypoints, detect_keypoints
from rse_pf.slam.tracking import (
    Features,
    GuidedMatchLimits,
    Observations,
    PredictedFeatures,
    fit_pose,
    match_predictions,
)
from tests.oracles import depths, matching

__all__ = ["HOSTILE_SIZES", "GuardedBuffer", "depth", "describe", "match", "track"]

Anything = npt.NDArray[Any]

# Camera of the inputs; its principal point is near a corner.
_CAMERA = Camera(fx=300.0, fy=310.0, cx=3.5, cy=4.0, width=640, height=480)
_HEAD = 8  # number of bytes at the start of an input that choose sizes and kinds; the others are the data
# Sizes of arrays that no caller may pass to the library, which has to refuse them.
HOSTILE_SIZES = (-1, -(2**63), 2**24 + 1, 2**31, 2**60, 2**63 - 1)
_PATTERN = 0xA5  # value of each byte of the guard behind a buffer
_GUARD_BYTES = 64  # size of the guard behind a buffer
_LEVELS = 8  # number of levels of ORB's image pyramid
# Values of options that an input may choose instead of ordinary numbers.
_SPECIAL_NUMBERS = (float("nan"), float("inf"), -1.0, 0.0, 1e300)


def match(data: bytes, meter: Meter) -> None:
    """Compare matches and points with the oracle, for each instruction set that the library may use."""
    if len(data) < _HEAD:
        return
    n, m, part = data[0] % 48, data[1] % 48, data[3]
    body = data[_HEAD:]
    bits = _cut(np.resize(np.frombuffer(body or b"\0", np.uint8), (n + m) * 32), data[5])
    reference, view = bits[: n * 32].reshape(n, 32), bits[n * 32 :].reshape(m, 32)
    ratio = _SPECIAL_NUMBERS[part % 5] if part > 250 else part / 128
    expected = matching.best_matches(reference, view, ratio)
    for lanes in ("avx512", "avx2", "portable"):
        found = meter.call(
            lambda _, lanes=lanes: match_orb(reference, view, ratio, lanes=lanes), data, ProtocolError
        )
        expect(_all_equal(found, expected), "matches are not those of the oracle")
    _match_directly(np.array(reference), np.array(view), ratio, len(expected[0]))
    _points_at(data, _cut(_numbers(data[2], body, 2 * m), data[5]).reshape(m, 2))


def _match_directly(reference: Anything, view: Anything, ratio: float, count: int) -> None:
    matches = _function("match", "rse_pf_match")
    n, m = len(reference), len(view)
    buffers = [GuardedBuffer(8 * words) for words in (n + 5 * m + 64, min(n, m), min(n, m))]

    def called(rows: int, view_rows: int) -> int:
        answer: int = matches(
            address_of(reference), rows, address_of(view), view_rows, ratio, 0, *(each.at for each in buffers)
        )
        return answer

    expect(called(n, m) == count, "the library called directly returns another number of matches")
    for size in HOSTILE_SIZES:
        expect(called(size, m) == -1 and called(n, size) == -1, f"{size} rows are not refused")
    for each in buffers:
        each.check()


def _points_at(data: bytes, pixels: Array) -> None:
    height, width = 1 + data[6] % 12, 1 + data[7] % 12
    body = (data[_HEAD:] + bytes(4))[: (len(data) - _HEAD) // 4 * 4 or 4]
    raw = np.frombuffer(body, "<f4") if data[2] % 2 else np.frombuffer(body, np.uint8).astype(np.float32) / 64
    depth_m = _cut(np.resize(raw, height * width), data[5]).reshape(height, width)
    options = FrontEndOptions(min_depth_m=0.1, max_depth_m=4.0, depth_spread_percent=100.0 * (data[3] / 64))
    camera = Camera(fx=1.5 * width, fy=1.6 * width, cx=width / 2, cy=height / 3, width=width, height=height)
    rgb = np.zeros((height, width, 3), np.uint8)
    if data[4] % 2:
        with np.errstate(invalid="ignore"):
            pixels = np.where(np.isfinite(pixels), np.abs(np.fmod(pixels, 13.0)), pixels)

    found = points_at(Frame(timestamp_s=0.0, rgb=rgb, depth_m=depth_m, camera=camera), pixels, options)

    expected = depths.points_at(depth_m, pixels, camera, 0.1, 4.0, options.depth_spread_percent / 100.0)
    expect(_all_equal((found,), (expected,)), "points are not those of the oracle")
    call, copies = _function("match", "rse_pf_points_at"), (np.array(depth_m), np.array(pixels))
    buffer = GuardedBuffer(24 * len(pixels))
    for wide, high, rows in ((size, 3, 1) for size in HOSTILE_SIZES):
        for sizes in ((wide, high, rows), (high, wide, rows), (width, height, wide)):
            answer = call(
                address_of(copies[0]), *sizes[:2], address_of(copies[1]), sizes[2], *[1.0] * 7, buffer.at
            )
            expect(answer == -1, f"the sizes {sizes} are not refused")
    buffer.check()


def depth(data: bytes, meter: Meter) -> None:
    """Check that refined poses are finite, equal with and without AVX2, and rigid if the first pose is."""
    if len(data) < _HEAD:
        return
    n, k, kind = data[0] % 64, data[1] % 70, data[2]
    numbers = _cut(_numbers(3 if kind % 4 == 1 else kind, data[_HEAD:], 16 + 6 * n), data[6])
    T = numbers[:16].reshape(4, 4)
    points, pixels = numbers[16 : 16 + 3 * n].reshape(n, 3), numbers[16 + 3 * n : 16 + 5 * n].reshape(n, 2)
    depths_m = numbers[16 + 5 * n :]
    if kind & 8:
        T = np.eye(4)
        points, depths_m = (np.clip(np.abs(np.nan_to_num(each)), 0.5, 9.0) for each in (points, depths_m))
        pixels = np.clip(np.nan_to_num(pixels), -900.0, 900.0)
    inliers = _cut(np.arange(k, dtype=np.int64) * (1 + data[7] % 5) - data[7] // 64, data[6])
    noise = DepthNoise(base_m=max(1e-5, data[3] / 1e4), growth_per_m=data[4] / 1e5, from_m=data[5] / 16.0)
    rmse_px = _SPECIAL_NUMBERS[data[3] % 5] if data[7] == 255 else data[5] / 8.0
    solution = PnpSolution(
        T_camera_world=T, inliers=inliers, rmse_px=rmse_px,
        covariance=np.eye(6), verdict="ok", reason="", engine="native",
    )  # fmt: skip
    arguments = (solution, points, pixels, depths_m, KINECT, noise)

    def refined(portable: bool) -> PnpSolution | None:
        answer: PnpSolution | None = meter.call(
            lambda _: refine_with_depth(*arguments, portable=portable), data, BadRequest
        )
        return answer

    first, second = refined(False), refined(True)
    if first is None or second is None:
        expect(first is second, "AVX2 changes which poses are refined")
    else:
        numbers = [(each.T_camera_world, each.covariance) for each in (first, second)]
        expect(_all_equal(*numbers), "AVX2 changes a refined pose")
    outside = k > n or bool(np.any((inliers < 0) | (inliers >= n)))
    expect(not outside or first is None, "inliers beyond the last row were refined")
    if first is not None and first is not solution:
        _check_refined(first, T)
    _refine_hostile_sizes(inliers, points)


def _check_refined(pose: PnpSolution, start: Array) -> None:
    T, covariance = pose.T_camera_world, pose.covariance
    expect(bool(np.isfinite(T).all() and np.isfinite(covariance).all()), "a pose that is not finite")
    expect(bool((np.diag(covariance) > 0).all() and (covariance == covariance.T).all()), "no covariance")
    expect(T[3].tolist() == [0.0, 0.0, 0.0, 1.0], "no pose")
    R = start[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() < 1e-9 and np.linalg.det(R) > 0:
        expect(bool(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-6), "not a rotation")


def _refine_hostile_sizes(inliers: Anything, points: Array) -> None:
    refine = _function("depth", "rse_pf_depth_refine")
    numbers, rows = np.ones(3 * len(points) + 1), np.array(inliers)
    for size in HOSTILE_SIZES:
        for n, k in ((size, 1), (1, size), (size, size)):
            request = np.zeros(2 + 4 + 8 + 16, dtype=np.int64)
            request[:1].view(np.uint32)[:] = (PART_ABIS["depth"], 0)
            request[1:3] = n, k
            request[3:7] = address_of(numbers), address_of(numbers), address_of(numbers), address_of(rows)
            request[7:15].view(np.float64)[:] = (300.0, 300.0, 1.0, 1.0, 1e-3, 0.0, 0.0, 1.0)
            result, work = GuardedBuffer(8 * (2 + 16 + 36)), GuardedBuffer(8 * 11 * 5)
            refine(address_of(request), work.at, result.at)
            expect(result.first() == 2, f"{n} rows with {k} inliers are not refused")
            result.check()
            work.check()


def describe(data: bytes, meter: Meter) -> None:
    """Check that any picture and keypoints give descriptors or None, and no write beyond a buffer.

    A refusal (ProtocolError) gives None, and a second call must give the same.  Keypoints that are detected
    in the picture lie within it.  *meter* measures the first call.
    """
    if len(data) < _HEAD:
        return
    height, width, n, levels, kind = data[0] % 180, data[1] % 180, data[2] % 32, data[4] % 40, data[5]
    scale = _SPECIAL_NUMBERS[data[3] % 5] if data[3] > 250 else 1.0 + data[3] / 255
    body = data[_HEAD:] or b"\0"
    gray = _cut(np.resize(np.frombuffer(body, np.uint8), height * width), data[6]).reshape(height, width)
    numbers = _numbers(kind, body, 3 * n)
    with np.errstate(over="ignore", invalid="ignore"):
        pixels, angles_deg = numbers[: 2 * n].astype(np.float32), numbers[2 * n :].astype(np.float32)
    octaves = np.resize(np.frombuffer(body, np.int8), n).astype(np.int32)
    if kind & 4 and 1.0 <= scale <= 2.0:  # most of the keypoints lie inside the picture
        octaves = octaves % 4
        edge = np.repeat(23.0 * scale**octaves, 2).reshape(n, 2)
        buffer = np.maximum((width, height) - 2.0 * edge, 1.0)
        places = edge + np.fmod(np.abs(np.nan_to_num(pixels)).reshape(n, 2), buffer)
        pixels = places.astype(np.float32).ravel()
    pixels, angles_deg = _cut(pixels, data[6]).reshape(n, 2), _cut(angles_deg, data[6])
    octaves = _cut(octaves.astype(np.int32), data[6])

    keypoints = Keypoints(pixels, np.zeros(n, np.float32), angles_deg, octaves)

    def described(_: bytes) -> Any:
        return describe_keypoints(gray, keypoints)

    found = meter.call(described, data, ProtocolError)
    expect(found is None or (found.shape == (n, 32) and found.dtype == np.uint8), "no descriptors")
    again = described(data)
    expect(type(found) is type(again) and np.array_equal(found, again), "two pictures of one")
    expect(found is None or bool(((octaves >= 0) & (octaves < _LEVELS)).all()), "an octave without a level")
    expect(found is None or bool(np.isfinite(pixels).all()), "a keypoint at a place that is no number")
    _describe_directly(gray, pixels, angles_deg, octaves, scale, levels)
    detected = detect_keypoints(gray, n, kind)
    if detected is not None:
        is_inside = (detected.pixels >= 0) & (detected.pixels < np.maximum(width, height))
        expect(bool(is_inside.all()), "a keypoint outside of the picture")
        expect(bool(np.isfinite(detected.responses + detected.angles_deg).all()), "no number")
        expect(bool(((detected.octaves >= 0) & (detected.octaves < _LEVELS)).all()), "an unknown level")
    _detect_directly(gray, n, scale, levels, kind)


def _detect_directly(gray: Anything, n: int, scale: float, levels: int, threshold: int) -> None:
    call, (height, width), gray = _function("match", "rse_pf_detect"), gray.shape, np.array(gray)
    with np.errstate(over="ignore", invalid="ignore"):
        scales = np.float32(scale) ** np.arange(max(levels, 1), dtype=np.float32)
    wanted = np.full(max(levels, 1), n, dtype=np.int64)
    work = GuardedBuffer(8 * (width * height // 2 + 8 * width + height + 64))
    out = [GuardedBuffer(each * n) for each in (8, 4, 4, 4)]

    def called(width: int, height: int, levels: int, threshold: int, buffer: int) -> int:
        request = np.zeros(8, dtype=np.int64)
        request[:5] = address_of(gray), width, height, address_of(scales), address_of(wanted)
        request[5:6].view(np.int32)[:] = levels, threshold
        request[6:] = buffer, work.at
        answer: int = call(address_of(request), *(each.at for each in out))
        return answer

    expect(called(width, height, levels, threshold, n) <= n, "more keypoints than there is buffer")
    for size in HOSTILE_SIZES:
        for sides in ((size, 50), (50, size)):
            expect(called(*sides, 8, 7, n) == -1, f"sides {sides} are not refused")
        expect(called(width, height, 8, 7, size) == -1, f"buffer for {size} is not refused")
    for bad in (-1, 0, 33, 2**31 - 1):
        expect(called(width, height, bad, 7, n) == -1, f"{bad} levels are not refused")
    for bad in (-1, 256, 2**31 - 1):
        expect(called(width, height, 8, bad, n) == -1, f"a threshold of {bad} is not refused")
    for each in (work, *out):
        each.check()


def _describe_directly(
    gray: Anything,
    pixels: Anything,
    angles_deg: Anything,
    octaves: Anything,
    scale: float,
    levels: int,
) -> None:
    call, (height, width), n = _function("match", "rse_pf_describe"), gray.shape, len(pixels)
    gray, pixels, octaves = np.array(gray), np.array(pixels), np.array(octaves)
    turned = np.nan_to_num(angles_deg.astype(np.float64))
    cosines, sines = np.cos(turned).astype(np.float32), np.sin(turned).astype(np.float32)
    scales = np.full(max(levels, 1), 1.0, np.float32) * np.float32(min(scale, 1e30))
    work, out = GuardedBuffer(8 * (3 * width * height // 8 + 7 * width + 64)), GuardedBuffer(32 * n)

    def called(width: int, height: int, levels: int, rows: int) -> int:
        answer: int = call(
            address_of(gray), width, height, address_of(scales), levels,
            *map(address_of, (pixels, cosines, sines, octaves)), rows, work.at, out.at,
        )  # fmt: skip
        return answer

    called(width, height, levels, n)
    for size in HOSTILE_SIZES:
        expect(called(size, 50, 8, n) == called(50, size, 8, n) == -1, f"a side of {size} is not refused")
        expect(called(width, height, 8, size) == -1, f"{size} keypoints are not refused")
    for levels in (-1, 0, 33, 2**31 - 1):
        expect(called(width, height, levels, n) == -1, f"{levels} levels are not refused")
    work.check()
    out.check()


def track(data: bytes, meter: Meter) -> None:
    """Compare matches near predicted pixels with the oracle; any numbers give a finite pose or none."""
    if len(data) < _HEAD:
        return
    m, n, kind, how = data[0] % 48, data[1] % 48, data[2], data[6]
    body = data[_HEAD:]
    numbers = _numbers(kind, body, 5 * (m + n))
    bits = np.resize(np.frombuffer(body or b"\0", np.uint8), (m + n) * 32)
    bits[: 32 * m : 7] ^= data[7]
    bits = _cut(bits, how)
    sides: list[tuple[Array, Array, Array, Anything]] = []
    for rows, all_numbers, side in (
        (m, numbers[: 5 * m], bits[: 32 * m]),
        (n, numbers[5 * m :], bits[32 * m :]),
    ):
        pixels, turns, sizes = np.split(all_numbers, (2 * rows, 4 * rows))
        if kind & 8:
            turns, sizes = np.tile([1.0, 0.0], rows), np.ones(rows)
        sides.append(
            (
                _cut(pixels, how).reshape(rows, 2), _cut(turns, how).reshape(rows, 2), _cut(sizes, how),
                side.reshape(rows, 32),
            )
        )  # fmt: skip
    sought, image = sides
    apart_px = _SPECIAL_NUMBERS[data[3] % 5] if data[3] > 250 else data[3] / 8.0
    distinct = meter.call(
        lambda _: measure_distinctiveness(image[3], image[0], apart_px), data, ProtocolError
    )
    expected_distinct = matching.measure_distinctiveness(image[3], image[0], apart_px)
    expect(np.array_equal(distinct, expected_distinct), "other distances")
    ratio = _SPECIAL_NUMBERS[data[5] % 5] if data[5] > 250 else data[5] / 128
    limits = GuidedMatchLimits(
        radius_px=min(10.0 ** (data[4] / 28.0) - 1.0, 1e9),
        lowe_ratio=ratio,
        distinctiveness_ratio=2.0 - ratio,
        min_orientation_cosine=-1.0 if kind & 32 else 0.9,
        max_size_ratio=9.0 if kind & 64 else 1.35,
        max_distance=data[7] + data[7] // 255,
    )
    numbers_of = (
        limits.radius_px,
        limits.lowe_ratio,
        limits.distinctiveness_ratio,
        limits.min_orientation_cosine,
        limits.max_size_ratio,
        limits.max_distance,
    )
    names = ("pixels", "orientations", "sizes", "descriptors")
    sought_features = PredictedFeatures(**dict(zip(names, sought, strict=True)))
    image_features = Features(
        **dict(zip(names, image, strict=True)),
        points_camera=np.full((len(image[0]), 3), np.nan),
        distinctiveness=distinct,
    )
    found = meter.call(
        lambda _: match_predictions(sought_features, image_features, limits), data, ProtocolError
    )
    expected = matching.match_predictions(sought_features, image_features, limits)
    expect(_all_equal(found, expected), "matches are not those of the oracle")
    _near_directly(sought, (*image, distinct), numbers_of, len(expected[0]))
    _fit(data, meter)


def _near_directly(
    sought: tuple[Anything, ...], image: tuple[Anything, ...], limits: tuple[float, ...], count: int
) -> None:
    near, distinct = _function("track", "rse_pf_match_near"), _function("track", "rse_pf_distinct")
    m, n, abi = len(sought[0]), len(image[0]), PART_ABIS["track"]
    arrays = [np.array(each) for each in (*sought, *image)]
    buffers = (
        GuardedBuffer(8 * (m + 12 * n + 16_400)),
        GuardedBuffer(8 * min(m, n)),
        GuardedBuffer(8 * min(m, n)),
    )

    def called(abi: int, sought_rows: int, rows: int, radius_px: float) -> int:
        request = np.zeros(2 + 1 + 9 + 5 + 1, dtype=np.int64)
        request[:1].view(np.uint32)[:] = (abi, 0)
        request[1:3] = sought_rows, rows
        request[3:12] = [address_of(each) for each in arrays]
        request[12:17].view(np.float64)[:] = (radius_px, *limits[1:5])
        request[17] = limits[5]
        answer: int = near(address_of(request), *(buffer.at for buffer in buffers))
        return answer

    expect(
        called(abi, m, n, limits[0]) == count, "the library called directly returns another number of matches"
    )
    expect(called(abi + 1, m, n, limits[0]) == -1, "another ABI is not refused")
    for size in HOSTILE_SIZES:
        expect(called(abi, size, n, 1.0) == called(abi, m, size, 1.0) == -1, f"{size} rows are not refused")
        answer = distinct(address_of(arrays[7]), address_of(arrays[4]), size, 6.0, buffers[0].at)
        expect(answer == -1, f"{size} rows have distances")
    for radius_px in (-1.0, float("nan"), float("inf")):
        expect(called(abi, m, n, radius_px) == -1, f"a radius of {radius_px} is not refused")
    for buffer in buffers:
        buffer.check()


def _fit(data: bytes, meter: Meter) -> None:
    n, kind = data[1] % 48, data[2]
    numbers = _numbers(kind, data[_HEAD:], 16 + 14 * n)
    T, points, spreads, pixels, deviations, depths_m, depths_dev_m = np.split(
        numbers, np.cumsum((16, 3 * n, 6 * n, 2 * n, n, n))
    )
    if kind & 128:  # points that a camera may measure
        T, depths_m = np.eye(4).ravel(), np.clip(np.nan_to_num(depths_m), 0.0, 9.0)
        points = np.clip(np.nan_to_num(points), -20.0, 20.0)
        pixels = np.clip(np.nan_to_num(pixels), -900.0, 900.0)
        spreads = np.tile([1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4], n) * (1.0 + data[4])
        deviations, depths_dev_m = np.ones(n), np.full(n, 0.01)
    full = spreads.reshape(n, 6)[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].reshape(n, 3, 3)
    cauchy = _SPECIAL_NUMBERS[data[5] % 5] if data[5] > 250 else 2.5
    rows = points.reshape(n, 3), spreads.reshape(n, 6)
    measured = pixels.reshape(n, 2), deviations, depths_m, depths_dev_m
    observed = Observations(
        points=rows[0], covariances=full, pixels=measured[0], pixel_sigmas_px=deviations, depths_m=depths_m,
        depth_sigmas_m=depths_dev_m,
    )  # fmt: skip
    found = meter.call(
        lambda _: fit_pose(observed, _CAMERA, T.reshape(4, 4), cauchy=cauchy), data, ProtocolError
    )
    if found is not None:
        pose, information = found.T_camera_world, found.information
        expect(bool(np.isfinite(pose).all() and np.isfinite(information).all()), "a pose that is not finite")
        expect(
            pose[3].tolist() == [0.0, 0.0, 0.0, 1.0] and np.array_equal(information, information.T), "no pose"
        )
        expect(bool(found.is_inlier.sum() >= 3), "a pose of two points")
    fit, is_in, result = (
        _function("track", "rse_pf_fit_pose"),
        GuardedBuffer(n),
        GuardedBuffer(8 * (1 + 16 + 36)),
    )
    arrays = [np.array(each) for each in (*rows, *measured)]
    for size in HOSTILE_SIZES:
        request = np.zeros(2 + 6 + 6 + 16, dtype=np.int64)
        request[:1].view(np.uint32)[:] = (PART_ABIS["track"], 0)
        request[1] = size
        request[2:8] = [address_of(each) for each in arrays]
        request[8:14].view(np.float64)[:] = (300.0, 300.0, 1.0, 1.0, 6.25, 11.3)
        expect(fit(address_of(request), is_in.at, result.at) == -1, f"{size} rows are not refused")
    is_in.check()
    result.check()


class GuardedBuffer:
    """A buffer of *size* bytes for the library, followed by a pattern that the library must not change."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._bytes = np.full(size + _GUARD_BYTES, _PATTERN, dtype=np.uint8)
        self.at = address_of(self._bytes)

    def check(self) -> None:
        expect(
            bool((self._bytes[self._size :] == _PATTERN).all()),
            "the library wrote beyond the end of a buffer",
        )

    def first(self) -> int:
        return int(self._bytes[:8].view(np.int64)[0])


def _cut(array: Anything, how: int) -> Anything:
    """Return a copy of *array* at the end of its memory block, at an odd address if *how* is odd."""
    if not how % 2:
        return np.array(array)
    moved = np.frombuffer(b"\0" + array.tobytes(), np.uint8)[1:]
    return moved.view(array.dtype)


def _numbers(kind: int, data: bytes, count: int) -> Array:
    """Return *count* numbers made of *data*: unchanged, small, or with NaN, infinity and 1e300 among them."""
    data = data or b"\0"
    if kind % 4 in (0, 3):
        found = np.frombuffer((data + bytes(8))[: max(len(data) // 8 * 8, 8)], "<f8")
    elif kind % 4 == 1:
        found = np.frombuffer(data, np.uint8).astype(np.float64) / 2.0
    else:
        found = np.frombuffer(data, np.int8).astype(np.float64) * 0.37
    found = np.resize(found, count).astype(np.float64)
    if kind & 16:
        found[kind % 7 :: 7] = np.resize(_SPECIAL_NUMBERS, len(found[kind % 7 :: 7]))
    return found


def _all_equal(found: tuple[Any, ...], expected: tuple[Any, ...]) -> bool:
    return all(
        a.shape == b.shape and np.array_equal(a, b, equal_nan=True)
        for a, b in zip(found, expected, strict=True)
    )


# Types of arguments in `_SIGNATURES`: pointer, integer, double.
_P = ctypes.c_void_p
_I = ctypes.c_int64
_D = ctypes.c_double
# Argument types and result type of each function of the library.
_SIGNATURES = {
    "rse_pf_match": ((_P, _I, _P, _I, _D, ctypes.c_uint32, _P, _P, _P), _I),
    "rse_pf_points_at": ((_P, _I, _I, _P, _I, *[_D] * 7, _P), ctypes.c_int32),
    "rse_pf_describe": ((_P, _I, _I, _P, ctypes.c_int32, *[_P] * 4, _I, _P, _P), ctypes.c_int32),
    "rse_pf_detect": ((_P,) * 5, _I),
    "rse_pf_depth_refine": ((_P,) * 3, None),
    "rse_pf_distinct": ((_P, _P, _I, _D, _P), ctypes.c_int32),
    "rse_pf_match_near": ((_P,) * 4, _I),
    "rse_pf_fit_pose": ((_P,) * 3, ctypes.c_int32),
}


@cache
def _function(part: str, name: str) -> Any:
    return core_function(part, name, *_SIGNATURES[name])

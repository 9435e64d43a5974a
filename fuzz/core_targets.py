"""The fuzz targets of the native core's front end, depth refinement and tracker: any numbers and sizes.

Each calls the library through the Python binding, and directly, with rooms of exactly the size that the C ABI
asks for.  Without a library they do nothing.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from fuzz.checks import expect
from fuzz.meter import Meter
from rse_pf.errors import ProtocolError
from rse_pf.geometry import Array, Camera
from rse_pf.native import address_of, find_library, load_part
from rse_pf.native_front_end import FrontEndCore, open_front_end
from rse_pf.native_matcher import MATCH_ABI
from rse_pf.native_tracker import TrackCore, open_tracker
from rse_pf.pnp import PnpSolution
from rse_pf.pnp.native_depth import DepthCore, RefinedPose, open_depth
from rse_pf.pnp.problems import KINECT
from rse_pf.slam.tracking import (
    ImageFeatures,
    NearLimits,
    Observations,
    SoughtFeatures,
    distinct_by_numpy,
    fit_pose_by_numpy,
    match_near_by_numpy,
)

__all__ = ["HOSTILE_SIZES", "Room", "depth", "describe", "match", "track"]

Anything = npt.NDArray[Any]

_CAMERA = Camera(fx=300.0, fy=310.0, cx=3.5, cy=4.0, width=640, height=480)
_HEAD = 8
HOSTILE_SIZES = (-1, -(2**63), 2**24 + 1, 2**31, 2**60, 2**63 - 1)
_PATTERN, _BEHIND = 0xA5, 64
_STRANGE = (float("nan"), float("inf"), -1.0, 0.0, 1e300)


def match(data: bytes, meter: Meter) -> None:
    """Compare matches and points with those of numpy, for all instructions that the library may use."""
    cores = _front_ends()
    if len(data) < _HEAD or not cores:
        return
    n, m, kind, part, most = data[0] % 48, data[1] % 48, data[2], data[3], data[4]
    body = data[_HEAD:]
    bits = _cut(np.resize(np.frombuffer(body or b"\0", np.uint8), (n + m) * 32), data[5])
    reference, frame = bits[: n * 32].reshape(n, 32), bits[n * 32 :].reshape(m, 32)
    numbers = _cut(_numbers(kind, body, 3 * n + 5 * m), data[5])
    points, seen = numbers[: 3 * n].reshape(n, 3), numbers[3 * n : 3 * (n + m)].reshape(m, 3)
    pixels = numbers[3 * (n + m) :].reshape(m, 2)
    ratio = _STRANGE[part % 5] if part > 250 else part / 128
    limit = 2**62 if most == 255 else most - 4
    arrays = reference, points, frame, pixels, seen

    found = [
        meter.call(
            lambda _, core=core: core.matches(
                reference, points, frame, pixels, seen, ratio=ratio, max_matches=limit
            ),
            data,
            ProtocolError,
        )
        for core in cores
    ]
    expected = _matches_by_numpy(*arrays, ratio, limit)
    for each in found:
        expect(each is not None and _all_equal(each, expected), "matches are not those of numpy")
    copies = [np.array(each) for each in arrays]
    _match_directly(copies, ratio, limit, len(expected[0]))
    _points_at(cores[0], data, pixels)


def _match_directly(arrays: list[Anything], ratio: float, limit: int, count: int) -> None:
    reference, points, frame, pixels, seen = arrays
    matches = _functions()["rse_pf_match"]
    n, m = len(reference), len(frame)
    room = min(n, m, max(limit, 0))
    rooms = [Room(8 * words) for words in (3 * n + 5 * m + 64, 3 * room, 2 * room, room)]
    # A room for one number more where there is none: a null pointer is refused.
    behind = [each.at for each in rooms]

    def called(rows: int, frame_rows: int) -> int:
        answer: int = matches(
            address_of(reference), address_of(points), rows, address_of(frame), address_of(pixels),
            address_of(seen), frame_rows, ratio, limit, 0, *behind,
        )  # fmt: skip
        return answer

    expect(called(n, m) == count, "another number of matches without the binding")
    for size in HOSTILE_SIZES:
        expect(called(size, m) == -1 and called(n, size) == -1, f"{size} rows are not refused")
    for each in rooms:
        each.check()


def _matches_by_numpy(
    reference: Anything, points: Array, frame: Anything, pixels: Array, seen: Array, ratio: float, limit: int
) -> tuple[Array, Array, Array]:
    known = np.flatnonzero(np.isfinite(points[:, 2]))
    taken: dict[int, tuple[int, int]] = {}
    if len(frame) >= 2:
        differ = np.unpackbits(np.bitwise_xor(reference[:, None], frame[None]), axis=2).sum(
            axis=2, dtype=np.int64
        )
        for row in known:
            pixel = int(differ[row].argmin())
            least, second = np.sort(differ[row])[:2]
            if least < ratio * second:
                taken[pixel] = min(taken.get(pixel, (257, 0)), (int(least), int(row)))
    kept = sorted((distance, row, pixel) for pixel, (distance, row) in taken.items())[: max(limit, 0)]
    rows, columns = np.array([k[1] for k in kept], dtype=int), np.array([k[2] for k in kept], dtype=int)
    order = np.argsort(pixels[columns, 0], kind="stable")
    rows, columns = rows[order], columns[order]
    with np.errstate(over="ignore", invalid="ignore"):
        depths = seen[columns, 2]
        depths = np.where(np.isfinite(depths), np.rint(depths * 1e3) / 1e3, 0.0)
        return np.rint(points[rows] * 1e4) / 1e4, np.rint(pixels[columns] * 1e2) / 1e2, depths


def _points_at(core: FrontEndCore, data: bytes, pixels: Array) -> None:
    height, width = data[6] % 12, data[7] % 12
    body = (data[_HEAD:] + bytes(4))[: (len(data) - _HEAD) // 4 * 4 or 4]
    raw = np.frombuffer(body, "<f4") if data[2] % 2 else np.frombuffer(body, np.uint8).astype(np.float32) / 64
    depth_m = _cut(np.resize(raw, height * width), data[5]).reshape(height, width)
    low, high, spread = (_STRANGE[data[3] % 5], 1e3, 0.05) if data[3] > 250 else (0.1, 4.0, data[3] / 64)
    limits = {"min_depth_m": low, "max_depth_m": high, "spread": spread}
    if data[4] % 2:
        with np.errstate(invalid="ignore"):
            pixels = np.where(np.isfinite(pixels), np.abs(np.fmod(pixels, 13.0)), pixels)

    found = core.points_at(depth_m, pixels, _CAMERA, **limits)

    if height == 0 or width == 0:
        expect(found is None, "an image without pixels has points")
        return
    expected = _points_by_numpy(depth_m, pixels, low, high, spread)
    expect(found is not None and _all_equal((found,), (expected,)), "points are not those of numpy")
    points_at, copies = _functions()["rse_pf_points_at"], (np.array(depth_m), np.array(pixels))
    room = Room(24 * len(pixels))
    for wide, high_, rows in ((size, 3, 1) for size in HOSTILE_SIZES):
        for sizes in ((wide, high_, rows), (high_, wide, rows), (width, height, wide)):
            answer = points_at(
                address_of(copies[0]), *sizes[:2], address_of(copies[1]), sizes[2], *[1.0] * 7, room.at
            )
            expect(answer == -1, f"the sizes {sizes} are not refused")
    room.check()


def _points_by_numpy(depth_m: Anything, pixels: Array, low: float, high: float, spread: float) -> Array:
    height, width = depth_m.shape
    depths = np.full(len(pixels), np.nan)
    for i, (column, row) in enumerate(np.rint(pixels)):
        if not (1 <= column < width - 1 and 1 <= row < height - 1):
            continue
        u, v = int(column), int(row)
        patch = depth_m[v - 1 : v + 2, u - 1 : u + 2].astype(np.float64).ravel()
        readings = np.sort(patch[(patch > 0.0) & np.isfinite(patch)])
        if len(readings) >= 5:
            median = readings[(len(readings) - 1) // 2]
            if readings[-1] - readings[0] < median * spread and low <= median <= high:
                depths[i] = median
    with np.errstate(over="ignore", invalid="ignore"):
        x = (pixels[:, 0] - _CAMERA.cx) / _CAMERA.fx * depths
        y = (pixels[:, 1] - _CAMERA.cy) / _CAMERA.fy * depths
    return np.column_stack((x, y, depths))


def depth(data: bytes, meter: Meter) -> None:
    """Check that any numbers give equal, finite poses with all instructions, rigid ones if they began so."""
    cores = _depth_cores()
    if len(data) < _HEAD or not cores:
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
    noise = (data[3] / 1e4, data[4] / 1e5, data[5] / 16.0)
    rmse_px = _STRANGE[data[3] % 5] if data[7] == 255 else data[5] / 8.0
    solution = PnpSolution(
        T_camera_world=T, inliers=inliers, rmse_px=rmse_px,
        covariance=np.eye(6), verdict="ok", reason="", engine="native",
    )  # fmt: skip
    arguments = (solution, points, pixels, depths_m, KINECT, noise)

    def refined(core: DepthCore) -> Any:
        return meter.call(lambda _: core.refine(*arguments), data, ProtocolError)

    found = [refined(core) for core in cores]
    first = found[0]
    for each in found[1:]:
        same = each == first if isinstance(first, str) else _all_equal(first[:2], each[:2])
        expect(same, "AVX2 changes a refined pose")
    outside = k > n or bool(np.any((inliers < 0) | (inliers >= n)))
    expect(not outside or first == "refused", "rows that are not there were refined")
    if isinstance(first, RefinedPose):
        _check_refined(first, T)
    _refine_hostile_sizes(inliers, points)


def _check_refined(pose: RefinedPose, start: Array) -> None:
    T, covariance = pose.T_camera_reference, pose.covariance
    expect(bool(np.isfinite(T).all() and np.isfinite(covariance).all()), "a pose that is not finite")
    expect(bool((np.diag(covariance) > 0).all() and (covariance == covariance.T).all()), "no covariance")
    expect(T[3].tolist() == [0.0, 0.0, 0.0, 1.0], "no pose")
    R = start[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() < 1e-9 and np.linalg.det(R) > 0:
        expect(bool(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-6), "not a rotation")


def _refine_hostile_sizes(inliers: Anything, points: Array) -> None:
    refine = _functions()["rse_pf_depth_refine"]
    numbers, rows = np.ones(3 * len(points) + 1), np.array(inliers)
    for size in HOSTILE_SIZES:
        for n, k in ((size, 1), (1, size), (size, size)):
            request = np.zeros(2 + 4 + 8 + 16, dtype=np.int64)
            request[:1].view(np.uint32)[:] = (1, 0)
            request[1:3] = n, k
            request[3:7] = address_of(numbers), address_of(numbers), address_of(numbers), address_of(rows)
            request[7:15].view(np.float64)[:] = (300.0, 300.0, 1.0, 1.0, 1e-3, 0.0, 0.0, 1.0)
            result, work = Room(8 * (2 + 16 + 36)), Room(8 * 11 * 5)
            refine(address_of(request), work.at, result.at)
            expect(result.first() == 2, f"{n} rows with {k} inliers are not refused")
            result.check()
            work.check()


def describe(data: bytes, meter: Meter) -> None:
    """Check that any picture and keypoints give descriptors or None, and that nothing else is written.

    So does a picture give keypoints, which lie within it.
    """
    cores = _front_ends()
    if len(data) < _HEAD or not cores:
        return
    height, width, n, levels, kind = data[0] % 180, data[1] % 180, data[2] % 32, data[4] % 40, data[5]
    scale = _STRANGE[data[3] % 5] if data[3] > 250 else 1.0 + data[3] / 255
    body = data[_HEAD:] or b"\0"
    gray = _cut(np.resize(np.frombuffer(body, np.uint8), height * width), data[6]).reshape(height, width)
    numbers = _numbers(kind, body, 3 * n)
    with np.errstate(over="ignore", invalid="ignore"):
        pixels, angles_deg = numbers[: 2 * n].astype(np.float32), numbers[2 * n :].astype(np.float32)
    octaves = np.resize(np.frombuffer(body, np.int8), n).astype(np.int32)
    if kind & 4 and 1.0 <= scale <= 2.0:  # most of them inside
        octaves = octaves % 4
        edge = np.repeat(23.0 * scale**octaves, 2).reshape(n, 2)
        room = np.maximum((width, height) - 2.0 * edge, 1.0)
        places = edge + np.fmod(np.abs(np.nan_to_num(pixels)).reshape(n, 2), room)
        pixels = places.astype(np.float32).ravel()
    pixels, angles_deg = _cut(pixels, data[6]).reshape(n, 2), _cut(angles_deg, data[6])
    octaves = _cut(octaves.astype(np.int32), data[6])

    def described(_: bytes) -> Any:
        return cores[0].describe(gray, pixels, angles_deg, octaves, scale=scale, levels=levels)

    found = meter.call(described, data, ProtocolError)
    expect(found is None or (found.shape == (n, 32) and found.dtype == np.uint8), "no descriptors")
    again = described(data)
    expect(type(found) is type(again) and np.array_equal(found, again), "two pictures of one")
    expect(found is None or bool(((octaves >= 0) & (octaves < levels)).all()), "an octave without a level")
    expect(found is None or bool(np.isfinite(pixels).all()), "a keypoint at a place that is no number")
    _describe_directly(gray, pixels, angles_deg, octaves, scale, levels)
    detected = cores[0].detect(gray, n, scale=scale, levels=levels, threshold=kind)
    if detected is not None:
        is_inside = (detected.pixels >= 0) & (detected.pixels < np.maximum(width, height))
        expect(bool(is_inside.all()), "a keypoint outside of the picture")
        expect(bool(np.isfinite(detected.responses + detected.angles_deg).all()), "no number")
        expect(bool(((detected.octaves >= 0) & (detected.octaves < levels)).all()), "an unknown level")
    _detect_directly(gray, n, scale, levels, kind)


def _detect_directly(gray: Anything, n: int, scale: float, levels: int, threshold: int) -> None:
    call, (height, width), gray = _functions()["rse_pf_detect"], gray.shape, np.array(gray)
    with np.errstate(over="ignore", invalid="ignore"):
        scales = np.float32(scale) ** np.arange(max(levels, 1), dtype=np.float32)
    wanted = np.full(max(levels, 1), n, dtype=np.int64)
    work = Room(8 * (width * height // 2 + 8 * width + height + 64))
    out = [Room(each * n) for each in (8, 4, 4, 4)]

    def called(width: int, height: int, levels: int, threshold: int, room: int) -> int:
        request = np.zeros(8, dtype=np.int64)
        request[:5] = address_of(gray), width, height, address_of(scales), address_of(wanted)
        request[5:6].view(np.int32)[:] = levels, threshold
        request[6:] = room, work.at
        answer: int = call(address_of(request), *(each.at for each in out))
        return answer

    expect(called(width, height, levels, threshold, n) <= n, "more keypoints than there is room")
    for size in HOSTILE_SIZES:
        for sides in ((size, 50), (50, size)):
            expect(called(*sides, 8, 7, n) == -1, f"sides {sides} are not refused")
        expect(called(width, height, 8, 7, size) == -1, f"room for {size} is not refused")
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
    call, (height, width), n = _functions()["rse_pf_describe"], gray.shape, len(pixels)
    gray, pixels, octaves = np.array(gray), np.array(pixels), np.array(octaves)
    turned = np.nan_to_num(angles_deg.astype(np.float64))
    cosines, sines = np.cos(turned).astype(np.float32), np.sin(turned).astype(np.float32)
    scales = np.full(max(levels, 1), 1.0, np.float32) * np.float32(min(scale, 1e30))
    work, out = Room(8 * (3 * width * height // 8 + 7 * width + 64)), Room(32 * n)

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
    """Compare matches near pixels with those of numpy; any numbers give a finite pose or none."""
    core = _track_core()
    if len(data) < _HEAD or core is None:
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
    apart_px = _STRANGE[data[3] % 5] if data[3] > 250 else data[3] / 8.0
    distinct = meter.call(lambda _: core.distinct(image[3], image[0], apart_px), data, ProtocolError)
    expect(distinct is not None, "no distances")
    expect(np.array_equal(distinct, distinct_by_numpy(image[3], image[0], apart_px)), "other distances")
    ratio = _STRANGE[data[5] % 5] if data[5] > 250 else data[5] / 128
    limits = NearLimits(
        radius_px=min(10.0 ** (data[4] / 28.0) - 1.0, 1e9), ratio=ratio, distinct_ratio=2.0 - ratio,
        min_cosine=-1.0 if kind & 32 else 0.9, max_size_ratio=9.0 if kind & 64 else 1.35,
        max_distance=data[7] + data[7] // 255,
    )  # fmt: skip
    numbers_of = (
        limits.radius_px, limits.ratio, limits.distinct_ratio, limits.min_cosine, limits.max_size_ratio,
        limits.max_distance,
    )  # fmt: skip
    found = meter.call(lambda _: core.match_near(sought, (*image, distinct), numbers_of), data, ProtocolError)
    names = ("pixels", "turns", "sizes", "descriptors")
    expected = match_near_by_numpy(
        SoughtFeatures(**dict(zip(names, sought, strict=True))),
        ImageFeatures(**dict(zip(names, image, strict=True)), distinct=distinct), limits,
    )  # fmt: skip
    expect(found is not None and _all_equal(found, expected), "matches are not those of numpy")
    _near_directly(sought, (*image, distinct), numbers_of, len(expected[0]))
    _fit(core, data, meter)


def _near_directly(
    sought: tuple[Anything, ...], image: tuple[Anything, ...], limits: tuple[float, ...], count: int
) -> None:
    near, distinct = _functions()["rse_pf_match_near"], _functions()["rse_pf_distinct"]
    m, n = len(sought[0]), len(image[0])
    arrays = [np.array(each) for each in (*sought, *image)]
    rooms = Room(8 * (m + 12 * n + 16_400)), Room(8 * min(m, n)), Room(8 * min(m, n))

    def called(abi: int, sought_rows: int, rows: int, radius_px: float) -> int:
        request = np.zeros(2 + 1 + 9 + 5 + 1, dtype=np.int64)
        request[:1].view(np.uint32)[:] = (abi, 0)
        request[1:3] = sought_rows, rows
        request[3:12] = [address_of(each) for each in arrays]
        request[12:17].view(np.float64)[:] = (radius_px, *limits[1:5])
        request[17] = limits[5]
        answer: int = near(address_of(request), *(room.at for room in rooms))
        return answer

    expect(called(2, m, n, limits[0]) == count, "another number of matches without the binding")
    expect(called(3, m, n, limits[0]) == -1, "another ABI is not refused")
    for size in HOSTILE_SIZES:
        expect(called(2, size, n, 1.0) == called(2, m, size, 1.0) == -1, f"{size} rows are not refused")
        answer = distinct(address_of(arrays[7]), address_of(arrays[4]), size, 6.0, rooms[0].at)
        expect(answer == -1, f"{size} rows have distances")
    for radius_px in (-1.0, float("nan"), float("inf")):
        expect(called(2, m, n, radius_px) == -1, f"a radius of {radius_px} is not refused")
    for room in rooms:
        room.check()


def _fit(core: TrackCore, data: bytes, meter: Meter) -> None:
    n, kind = data[1] % 48, data[2]
    numbers = _numbers(kind, data[_HEAD:], 16 + 14 * n)
    T, points, spreads, pixels, deviations, depths_m, depths_dev_m = np.split(
        numbers, np.cumsum((16, 3 * n, 6 * n, 2 * n, n, n))
    )
    if kind & 128:  # what a camera may measure
        T, depths_m = np.eye(4).ravel(), np.clip(np.nan_to_num(depths_m), 0.0, 9.0)
        points = np.clip(np.nan_to_num(points), -20.0, 20.0)
        pixels = np.clip(np.nan_to_num(pixels), -900.0, 900.0)
        spreads = np.tile([1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4], n) * (1.0 + data[4])
        deviations, depths_dev_m = np.ones(n), np.full(n, 0.01)
    full = spreads.reshape(n, 6)[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)].reshape(n, 3, 3)
    limits = (_STRANGE[data[5] % 5] if data[5] > 250 else 6.25, 11.3)
    rows = points.reshape(n, 3), spreads.reshape(n, 6)
    measured = pixels.reshape(n, 2), deviations, depths_m, depths_dev_m

    def fitted(_: bytes) -> Any:
        return core.fit_pose(rows, measured, _CAMERA, limits, T.reshape(4, 4))

    found = meter.call(fitted, data, ProtocolError)
    if found is not None:
        pose, information, is_inlier = found
        expect(bool(np.isfinite(pose).all() and np.isfinite(information).all()), "a pose that is not finite")
        expect(
            pose[3].tolist() == [0.0, 0.0, 0.0, 1.0] and np.array_equal(information, information.T), "no pose"
        )
        expect(is_inlier.shape == (n,) and bool(is_inlier.sum() >= 3), "a pose of two points")
    observed = Observations(
        points=rows[0], spreads=full, pixels=measured[0], pixels_px=deviations, depths_m=depths_m,
        depths_dev_m=depths_dev_m,
    )  # fmt: skip
    with np.errstate(all="ignore"):
        fit_pose_by_numpy(observed, _CAMERA, T.reshape(4, 4), cauchy=2.5, gate2=11.3)
    fit, is_in, result = _functions()["rse_pf_fit_pose"], Room(n), Room(8 * (1 + 16 + 36))
    arrays = [np.array(each) for each in (*rows, *measured)]
    for size in HOSTILE_SIZES:
        request = np.zeros(2 + 6 + 6 + 16, dtype=np.int64)
        request[:1].view(np.uint32)[:] = (2, 0)
        request[1] = size
        request[2:8] = [address_of(each) for each in arrays]
        request[8:14].view(np.float64)[:] = (300.0, 300.0, 1.0, 1.0, 6.25, 11.3)
        expect(fit(address_of(request), is_in.at, result.at) == -1, f"{size} rows are not refused")
    is_in.check()
    result.check()


class Room:
    """Memory of exactly *size* bytes for the library, with a pattern behind it."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._bytes = np.full(size + _BEHIND, _PATTERN, dtype=np.uint8)
        self.at = address_of(self._bytes)

    def check(self) -> None:
        expect(bool((self._bytes[self._size :] == _PATTERN).all()), "the library wrote behind its room")

    def first(self) -> int:
        return int(self._bytes[:8].view(np.int64)[0])


def _cut(array: Anything, how: int) -> Anything:
    """Return the same numbers in memory that ends behind them; at an odd address if *how* is odd."""
    if not how % 2:
        return np.array(array)
    moved = np.frombuffer(b"\0" + array.tobytes(), np.uint8)[1:]
    return moved.view(array.dtype)


def _numbers(kind: int, data: bytes, count: int) -> Array:
    """Return *count* numbers of *data*: as they are, or small, or with strange ones among them."""
    data = data or b"\0"
    if kind % 4 in (0, 3):
        found = np.frombuffer((data + bytes(8))[: max(len(data) // 8 * 8, 8)], "<f8")
    elif kind % 4 == 1:
        found = np.frombuffer(data, np.uint8).astype(np.float64) / 2.0
    else:
        found = np.frombuffer(data, np.int8).astype(np.float64) * 0.37
    found = np.resize(found, count).astype(np.float64)
    if kind & 16:
        found[kind % 7 :: 7] = np.resize(_STRANGE, len(found[kind % 7 :: 7]))
    return found


def _all_equal(found: tuple[Any, ...], expected: tuple[Any, ...]) -> bool:
    return all(
        a.shape == b.shape and np.array_equal(a, b, equal_nan=True)
        for a, b in zip(found, expected, strict=True)
    )


@cache
def _front_ends() -> tuple[FrontEndCore, ...]:
    path = find_library()
    return (
        () if path is None else tuple(open_front_end(path, lanes) for lanes in ("avx512", "avx2", "portable"))
    )


@cache
def _depth_cores() -> tuple[DepthCore, ...]:
    path = find_library()
    return () if path is None else (open_depth(path), open_depth(path, portable=True))


@cache
def _track_core() -> TrackCore | None:
    path = find_library()
    return None if path is None else open_tracker(path)


@cache
def _functions() -> dict[str, Any]:
    """Return the functions of the C ABI; `open_front_end` and `open_depth` set the types of their own."""
    path = find_library()
    assert path is not None
    names = ("rse_pf_match", "rse_pf_points_at", "rse_pf_describe", "rse_pf_detect")
    found = dict(zip(names, load_part(path, "match", MATCH_ABI, *names), strict=True))
    pointer, size, number = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
    found["rse_pf_match"].argtypes = (
        pointer, pointer, size, *[pointer] * 3, size, number, size, ctypes.c_uint32, *[pointer] * 4
    )  # fmt: skip
    found["rse_pf_match"].restype = size
    found["rse_pf_points_at"].argtypes = (pointer, size, size, pointer, size, *[number] * 7, pointer)
    found["rse_pf_describe"].argtypes = (
        pointer, size, size, pointer, ctypes.c_int32, *[pointer] * 4, size, pointer, pointer
    )  # fmt: skip
    found["rse_pf_detect"].argtypes, found["rse_pf_detect"].restype = (pointer,) * 5, size
    (refine,) = load_part(path, "depth", 1, "rse_pf_depth_refine")
    refine.argtypes, refine.restype = (pointer,) * 3, None
    names = ("rse_pf_distinct", "rse_pf_match_near", "rse_pf_fit_pose")
    found.update(zip(names, load_part(path, "track", 2, *names), strict=True))
    found["rse_pf_distinct"].argtypes = (pointer, pointer, size, number, pointer)
    found["rse_pf_match_near"].argtypes, found["rse_pf_match_near"].restype = (pointer,) * 4, size
    found["rse_pf_fit_pose"].argtypes = (pointer,) * 3
    return {**found, "rse_pf_depth_refine": refine}

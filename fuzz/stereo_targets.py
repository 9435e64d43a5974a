"""The fuzz target of the native core's stereo matcher: any two pictures, pixels and limits.

It calls the library through the Python binding, and directly with hostile sizes.  Without a library it does
nothing.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np

from fuzz.checks import expect
from fuzz.core_targets import HOSTILE_SIZES, Room
from fuzz.meter import Meter
from rse_pf.errors import BadRequest, ProtocolError
from rse_pf.native import address_of, find_library, load_part
from rse_pf.native_stereo import StereoCore, StereoRequest, open_stereo
from rse_pf.slam.stereo import StereoOptions, disparities_by_numpy

__all__ = ["stereo"]

_HEAD = 8
_STRANGE = (float("nan"), float("inf"), -1.0, 0.0, 1e300)


def stereo(data: bytes, meter: Meter) -> None:
    """Compare disparities with those of numpy; any numbers give a disparity within the limits, or NaN."""
    core = _core()
    if len(data) < _HEAD or core is None:
        return
    height, width, n, most, shift, limits, misaligned = data[:7]
    width, most = max(width, 1), max(4 * most if misaligned & 2 else most, 1)
    height = max(height, 1)
    body = np.frombuffer(data[_HEAD:] or b"\0", np.uint8)
    left = np.resize(body, height * width).reshape(height, width)
    right = np.roll(left, -shift, axis=1) ^ np.resize(body[::-1] >> (data[7] % 8), left.shape)
    where = np.resize(body[body.size // 2 :], 2 * n).astype(np.float64).reshape(n, 2)
    where[1::7] = _STRANGE[limits % 5]
    options = StereoOptions(
        min_disparity_px=min(0.25 + limits / 64, most), max_disparity_px=min(most, 1024),
        min_likeness=0.1 + limits / 300, uniqueness=0.5 + limits / 600, left_right_px=limits % 4 - 1,
    )  # fmt: skip
    numbers = (options.min_disparity_px, options.min_likeness, options.uniqueness)
    rest = (options.max_disparity_px, options.left_right_px)

    found = meter.call(lambda _: core.disparities(left, right, where, numbers, *rest), data, ProtocolError)
    expect(found is not None, "a pair was refused")
    expected = disparities_by_numpy(left, right, where, options)
    # Where an iteration is about to fail, the order of a sum decides.
    differ = ~np.isclose(found, expected, atol=1e-6, equal_nan=True)
    expect(int(differ.sum()) <= 1 + n // 50, "disparities are not those of numpy")
    known = found[np.isfinite(found)]
    inside = (known >= options.min_disparity_px) & (known <= options.max_disparity_px + 1.25)
    expect(bool(inside.all()), "a disparity beyond its limits")
    for strange in _STRANGE:
        try:
            core.disparities(left, right, where, (strange,) * 3, *rest)
        except BadRequest:
            continue
    _directly(left, right, where)


def _directly(left: np.ndarray, right: np.ndarray, where: np.ndarray) -> None:  # type: ignore[type-arg]
    path = find_library()
    assert path is not None
    (call,) = load_part(path, "stereo", 1, "rse_pf_disparities")
    call.argtypes, call.restype = (ctypes.c_void_p,) * 2, ctypes.c_int32
    left, right, where = np.array(left), np.array(right), np.array(where)
    room = Room(8 * len(where))
    height, width = left.shape

    def called(abi: int, size: tuple[int, int, int], most: int) -> int:
        request = StereoRequest(
            abi, 0, *size[:2], address_of(left), address_of(right), size[2], address_of(where),
            1.0, 0.5, 0.8, most, 1,
        )  # fmt: skip
        answer: int = call(ctypes.addressof(request), room.at)
        return answer

    expect(called(1, (width, height, len(where)), 8) == 0, "a pair was refused")
    expect(called(2, (width, height, len(where)), 8) == -1, "another ABI was taken")
    for size in HOSTILE_SIZES:
        for sizes in ((size, height, 1), (width, size, 1), (width, height, size)):
            expect(called(1, sizes, 8) == -1, f"the sizes {sizes} are not refused")
        expect(called(1, (width, height, len(where)), size) == -1, f"disparities to {size} are not refused")
    room.check()


@cache
def _core() -> StereoCore | None:
    path = find_library()
    return None if path is None else open_stereo(path)

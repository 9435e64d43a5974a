"""Fuzz the native core's stereo matcher with any two pictures, pixels and limits.

The target calls the library through the Python binding, and directly with hostile sizes.
"""

from __future__ import annotations

import ctypes

import numpy as np

from fuzz.checks import expect
from fuzz.core_targets import HOSTILE_SIZES, GuardedBuffer
from fuzz.meter import Meter
from rse_pf.errors import ProtocolError
from rse_pf.native import PART_ABIS, address_of, core_function
from rse_pf.slam.stereo import StereoOptions, StereoRequest, disparities
from tests.oracles import disparities as oracle

__all__ = ["stereo"]

_HEAD = 8  # number of bytes at the start of an input that choose sizes and limits
# Values of options that an input may choose instead of ordinary numbers.
_SPECIAL_NUMBERS = (float("nan"), float("inf"), -1.0, 0.0, 1e300)


def stereo(data: bytes, meter: Meter) -> None:
    """Compare disparities with their definition; any numbers give a disparity within the limits, or NaN."""
    if len(data) < _HEAD:
        return
    height, width, n, most, shift, limits, misaligned = data[:7]
    width, most = max(width, 1), max(4 * most if misaligned & 2 else most, 1)
    height = max(height, 1)
    body = np.frombuffer(data[_HEAD:] or b"\0", np.uint8)
    left = np.resize(body, height * width).reshape(height, width)
    right = np.roll(left, -shift, axis=1) ^ np.resize(body[::-1] >> (data[7] % 8), left.shape)
    where = np.resize(body[body.size // 2 :], 2 * n).astype(np.float64).reshape(n, 2)
    where[1::7] = _SPECIAL_NUMBERS[limits % 5]
    options = StereoOptions(
        min_disparity_px=min(0.25 + limits / 64, most), max_disparity_px=min(most, 1024),
        min_likeness=0.1 + limits / 300, uniqueness=0.5 + limits / 600, left_right_px=limits % 4 - 1,
    )  # fmt: skip
    found = meter.call(lambda _: disparities(left, right, where, options), data, ProtocolError)
    expect(found is not None, "a pair was refused")
    expected = oracle.disparities(left, right, where, options)
    # If an iteration is about to fail, or two positions match equally well, the order of a sum decides.
    differ = ~np.isclose(found, expected, atol=1e-6, equal_nan=True)
    expect(int(differ.sum()) <= 1 + n // 50, "disparities are not those of the definition")
    known = found[np.isfinite(found)]
    inside = (known >= options.min_disparity_px) & (known <= options.max_disparity_px + 1.25)
    expect(bool(inside.all()), "a disparity beyond its limits")
    _directly(left, right, where)


def _directly(left: np.ndarray, right: np.ndarray, where: np.ndarray) -> None:  # type: ignore[type-arg]
    pointer = ctypes.c_void_p
    call = core_function("stereo", "rse_pf_disparities", (pointer, pointer), ctypes.c_int32)
    left, right, where = np.array(left), np.array(right), np.array(where)
    buffer = GuardedBuffer(8 * len(where))
    (height, width), abi = left.shape, PART_ABIS["stereo"]

    def called(abi: int, size: tuple[int, int, int], most: int) -> int:
        request = StereoRequest(
            abi, 0, *size[:2], address_of(left), address_of(right), size[2], address_of(where),
            1.0, 0.5, 0.8, most, 1,
        )  # fmt: skip
        answer: int = call(ctypes.addressof(request), buffer.at)
        return answer

    expect(called(abi, (width, height, len(where)), 8) == 0, "a pair was refused")
    expect(called(abi + 1, (width, height, len(where)), 8) == -1, "another ABI was taken")
    for size in HOSTILE_SIZES:
        for sizes in ((size, height, 1), (width, size, 1), (width, height, size)):
            expect(called(abi, sizes, 8) == -1, f"the sizes {sizes} are not refused")
        expect(called(abi, (width, height, len(where)), size) == -1, f"disparities to {size} are not refused")
    buffer.check()

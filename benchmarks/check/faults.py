"""Plant a known fault into the frames of a drive: calibration, depth, times and images.

Values are in the convention of `client_sdk.check.findings.FaultKind`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from client_sdk.check.findings import FaultKind
from client_sdk.frontend import Frame
from rse_pf.geometry import Camera

__all__ = ["FAULTS", "Fault"]

_DARK_BRIGHTNESS = 12.0  # brightness that replaces 255 in a dark image
_STRETCH = 10
"""Number of successive frames from one of two cameras; also half the period of light and dark frames."""

Plant = Callable[[Iterable[Frame]], Iterator[Frame]]
"""Plants a fault: returns the frames of a drive with the fault."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault at one severity.

    Attributes:
        name: Name of the series of faults, and the number of the severity, such as ``fx-1``.
        kind: The kind that a finding has to name.
        value: The value that a finding has to state, in the unit of its kind; None if only the kind counts.
        plant: Plants the fault into the frames of a drive.
        needs: What a drive needs for the fault to be found, ``depth``, ``odometry`` or ``stereo``; empty if
            nothing.
    """

    name: str
    kind: FaultKind
    value: float | None
    plant: Plant
    needs: str = ""


def _each(change: Callable[[Frame], Frame]) -> Plant:
    return lambda frames: map(change, frames)


def _camera(frame: Frame, **changed: float) -> Frame:
    camera = frame.camera
    values: dict[str, Any] = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    for name, value in changed.items():
        values[name] = values[name] * (1.0 + value) if name in ("fx", "fy") else values[name] + value
    return replace(frame, camera=Camera(**values, width=camera.width, height=camera.height))


def _focal(share: float) -> Plant:
    return _each(partial(_camera, fx=share))


def _both_focal(share: float) -> Plant:
    return _each(partial(_camera, fx=share, fy=share))


def _principal(offset_px: float) -> Plant:
    return _each(partial(_camera, cx=offset_px))


def _remapped(frame: Frame, x: npt.NDArray[np.float32], y: npt.NDArray[np.float32]) -> Frame:
    rgb = cv2.remap(frame.rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    depth_m = cv2.remap(frame.depth_m, x, y, cv2.INTER_NEAREST)
    return replace(frame, rgb=np.asarray(rgb, np.uint8), depth_m=np.asarray(depth_m, np.float32))


def _distorted(k1: float) -> Plant:
    """Plant the distortion *k1* of a lens; images are magnified so far that no border is empty."""

    def change(frame: Frame) -> Frame:
        camera = frame.camera
        rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        corner = np.hypot((camera.width / 2) / camera.fx, (camera.height / 2) / camera.fy)
        zoom = 1.0 if k1 > 0 else 1.0 / (1.0 + 1.3 * k1 * corner**2)
        x, y = (columns - camera.cx) / (zoom * camera.fx), (rows - camera.cy) / (zoom * camera.fy)
        bent = np.hypot(x, y)
        straight = bent.copy()
        for _ in range(30):
            straight = bent / (1.0 + k1 * straight**2)
        scale = np.where(bent > 0, straight / np.maximum(bent, 1e-12), 1.0)
        seen_x = (x * scale * camera.fx + camera.cx).astype(np.float32)
        seen_y = (y * scale * camera.fy + camera.cy).astype(np.float32)
        changed = _remapped(frame, seen_x, seen_y)
        return _camera(changed, fx=zoom - 1.0, fy=zoom - 1.0)

    return _each(change)


def _zoomed(frame: Frame, zoom: float) -> Frame:
    """Return the frame of a camera with *zoom* times the focal length; its intrinsics do not change."""
    camera = frame.camera
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    x = (columns - np.float32(camera.cx)) / np.float32(zoom) + np.float32(camera.cx)
    y = (rows - np.float32(camera.cy)) / np.float32(zoom) + np.float32(camera.cy)
    return _remapped(frame, x, y)


def _two_cameras(zoom: float, stretch: int | None) -> Plant:
    """Replace frames by those of a camera of *zoom* times the focal length that has the same calibration.

    Every second run of *stretch* frames is replaced, or the second half of the drive if *stretch* is None.
    """

    def changed(frames: Iterable[Frame]) -> Iterator[Frame]:
        every = list(frames)
        turn = stretch or max(1, (len(every) + 1) // 2)
        for row, frame in enumerate(every):
            yield _zoomed(frame, zoom) if row // turn % 2 else frame

    return changed


def _moving_focal(share: float) -> Plant:
    def changed(frames: Iterable[Frame]) -> Iterator[Frame]:
        every = list(frames)
        for row, frame in enumerate(every):
            yield _zoomed(frame, 1.0 + share * row / max(1, len(every) - 1))

    return changed


def _depth(scale: float, offset_m: float) -> Plant:
    def change(frame: Frame) -> Frame:
        depth_m = np.where(frame.depth_m > 0, frame.depth_m * scale + offset_m, 0.0)
        return replace(frame, depth_m=np.maximum(depth_m, 0.0).astype(np.float32))

    return _each(change)


def _late_depth(delay_s: float) -> Plant:
    """Plant a delay of depth: each frame gets the depth image of the frame that is about *delay_s* older.

    The first frames, which have no such older frame, are left out.
    """

    def changed(frames: Iterable[Frame]) -> Iterator[Frame]:
        earlier: deque[tuple[float, npt.NDArray[np.float32]]] = deque()
        for frame in frames:
            earlier.append((frame.timestamp_s, frame.depth_m))
            wanted = frame.timestamp_s - delay_s
            while len(earlier) > 1 and abs(earlier[1][0] - wanted) <= abs(earlier[0][0] - wanted):
                earlier.popleft()
            if abs(earlier[0][0] - wanted) < 0.6 * delay_s or earlier[0][0] <= wanted:
                yield replace(frame, depth_m=earlier[0][1])

    return changed


def _stamped(delay_s: float) -> Plant:
    return _each(lambda frame: replace(frame, timestamp_s=frame.timestamp_s + delay_s))


def _some(change: Callable[[Frame, npt.NDArray[np.uint8] | None], Frame], every: int) -> Plant:
    """Change each *every*-th frame by *change*, a function of the frame and the image before it or None."""

    def changed(frames: Iterable[Frame]) -> Iterator[Frame]:
        before: npt.NDArray[np.uint8] | None = None
        for row, frame in enumerate(frames):
            yield change(frame, before) if row % every == every - 1 else frame
            before = frame.rgb

    return changed


def _blurred(length_px: int, every: int = 2) -> Plant:
    kernel = np.zeros((length_px, length_px), np.float32)
    kernel[length_px // 2] = 1.0 / length_px

    def change(frame: Frame, _: object) -> Frame:
        turned = kernel if int(1e3 * frame.timestamp_s) % 400 < 200 else kernel.T
        return replace(frame, rgb=np.asarray(cv2.filter2D(frame.rgb, -1, turned), np.uint8))

    return _some(change, every)


def _repeated(every: int) -> Plant:
    return _some(lambda frame, before: frame if before is None else replace(frame, rgb=before), every)


def _dark(share: float) -> Plant:
    """Darken the first *share* of every 2 * `_STRETCH` frames to a twentieth of the light."""

    def changed(frames: Iterable[Frame]) -> Iterator[Frame]:
        for row, frame in enumerate(frames):
            if row % (2 * _STRETCH) < 2 * _STRETCH * share:
                dark = np.rint(frame.rgb * (_DARK_BRIGHTNESS / 255.0)).astype(np.uint8)
                frame = replace(frame, rgb=dark)
            yield frame

    return changed


def _missing(*rows: int) -> Plant:
    """Leave out the frames with the indices *rows* (0 to 9) of each ten frames."""
    return lambda frames: (frame for row, frame in enumerate(frames) if row % 10 not in rows)


def _jittered(share: float) -> Plant:
    """Change each time stamp by up to *share* of the median interval between frames, in both directions."""

    def changed(frames: Iterable[Frame]) -> Iterator[Frame]:
        every, rng = list(frames), np.random.default_rng(6)
        step_s = float(np.median(np.diff([frame.timestamp_s for frame in every])))
        for frame in every:
            yield replace(frame, timestamp_s=frame.timestamp_s + step_s * share * float(rng.uniform(-1, 1)))

    return changed


def _mirrored(*, colour: bool, depth: bool) -> Plant:
    def change(frame: Frame) -> Frame:
        return replace(
            frame,
            rgb=np.ascontiguousarray(frame.rgb[:, ::-1]) if colour else frame.rgb,
            depth_m=np.ascontiguousarray(frame.depth_m[:, ::-1]) if depth else frame.depth_m,
        )

    return _each(change)


def _baseline(share: float) -> Plant:
    def change(frame: Frame) -> Frame:
        assert frame.stereo is not None
        return replace(
            frame, stereo=replace(frame.stereo, baseline_m=(1.0 + share) * frame.stereo.baseline_m)
        )

    return _each(change)


def _shifted(offset_px: float) -> Plant:
    """Shift right images by *offset_px* to the right, so that disparities are smaller by *offset_px*."""
    moved = np.array([[1.0, 0.0, offset_px], [0.0, 1.0, 0.0]])

    def change(frame: Frame) -> Frame:
        assert frame.stereo is not None
        gray = cv2.warpAffine(
            frame.stereo.gray, moved, frame.stereo.gray.shape[::-1], flags=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return replace(frame, stereo=replace(frame.stereo, gray=np.asarray(gray, np.uint8)))

    return _each(change)


def _swapped(frame: Frame) -> Frame:
    """Return a frame in which the left and the right image are exchanged."""
    assert frame.stereo is not None
    left = np.repeat(frame.stereo.gray[:, :, None], 3, axis=2)
    right = np.ascontiguousarray(frame.rgb[:, :, 1])
    return replace(frame, rgb=left, stereo=replace(frame.stereo, gray=right))


def _listed() -> Iterator[Fault]:
    """Yield all faults, series by series; the severities of a series are numbered from 1."""

    def three(
        kind: FaultKind, name: str, faults: list[tuple[float | None, Plant]], needs: str = ""
    ) -> Iterator[Fault]:
        for severity, (value, planted) in enumerate(faults, 1):
            yield Fault(name=f"{name}-{severity}", kind=kind, value=value, plant=planted, needs=needs)

    kinds, half = FaultKind, 0.5
    yield from three(kinds.FOCAL_LENGTH, "fx", [(v, _focal(v)) for v in (0.03, -0.06, 0.10)])
    yield from three(kinds.PRINCIPAL_POINT, "cx", [(v, _principal(v)) for v in (8.0, 15.0, -30.0)])
    yield from three(kinds.DISTORTION, "k1", [(v, _distorted(v)) for v in (-0.06, 0.10, -0.15)])
    yield from three(
        kinds.DEPTH_SCALE, "depth-scale", [(v, _depth(1.0 / (1.0 + v), 0.0)) for v in (0.03, -0.10, 4.0)],
        "odometry",
    )  # fmt: skip
    yield from three(
        kinds.DEPTH_OFFSET, "depth-offset", [(v, _depth(1.0, v)) for v in (0.03, -0.05, 0.10)], "depth"
    )
    yield from three(kinds.DEPTH_DELAY, "depth-late", [(v, _late_depth(v)) for v in (0.1, 0.2, 0.3)], "depth")
    yield from three(
        kinds.STAMP_DELAY, "stamps-late", [(v, _stamped(v)) for v in (0.05, 0.1, -0.2)], "odometry"
    )
    yield from three(kinds.BLUR, "blur", [(half, _blurred(px)) for px in (9, 15, 25)])
    yield from three(
        kinds.MIRRORED, "mirrored",
        [(None, _mirrored(colour=c, depth=d)) for c, d in ((True, True), (False, True), (True, False))],
        "odometry",
    )  # fmt: skip
    yield from three(
        kinds.TWO_CAMERAS, "two-cameras",
        [(z - 1.0, _two_cameras(z, s)) for z, s in ((1.1, None), (1.1, _STRETCH), (1.25, None))],
    )  # fmt: skip
    yield from three(kinds.FOCAL_LENGTH, "f", [(v, _both_focal(v)) for v in (0.03, -0.06, 0.10)])
    yield from three(kinds.REPEATED, "repeated", [(1.0 / n, _repeated(n)) for n in (6, 3, 2)])
    yield from three(
        kinds.MISSING, "missing", [(len(r) / 10, _missing(*r)) for r in ((4,), (4, 7, 8), (2, 6, 7, 8))]
    )
    yield from three(kinds.DARK, "dark", [(v, _dark(v)) for v in (0.1, 0.25, 0.5)])
    yield from three(kinds.JITTER, "jitter", [(None, _jittered(v)) for v in (0.25, 0.35, 0.45)])
    yield from three(kinds.MOVING_FOCAL_LENGTH, "focus", [(v, _moving_focal(v)) for v in (0.03, 0.06, 0.12)])
    yield from three(kinds.BASELINE, "baseline", [(v, _baseline(v)) for v in (0.03, -0.03, 0.1)], "stereo")
    yield from three(
        kinds.DISPARITY_OFFSET, "disparity", [(v, _shifted(v)) for v in (0.3, -0.3, 0.6)], "stereo"
    )
    yield from three(kinds.SWAPPED_CAMERAS, "swapped", [(None, _each(_swapped))], "stereo")


FAULTS: tuple[Fault, ...] = tuple(_listed())
"""Faults in series of three severities each; swapped cameras have one severity only.  A kind may have several
series: ``fx`` is a wrong fx alone, ``f`` a wrong fx and fy."""

"""Make the points and the image of a keyframe, its attachments, and store them as objects in the background.

A keyframe holds a reference (digest and size) to each attachment; the attachments themselves are objects of
the robot in the object store.  The map server makes the cloud of the map from the points, and exports the
images.  Pose queries and keyframes have priority: each upload waits for them, at most 1 s.  Uploads have a
limited byte rate, and the oldest attachments are dropped when too many wait.  If the points of a keyframe are
dropped, the cloud of the map is thinner there, and nothing else changes.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.concurrency.user_callbacks import UserCallbacks
from client_sdk.frontend import Features, Frame, load_opencv
from client_sdk.live.options import LiveOptions
from client_sdk.tracking.segments import select_certain_rows
from client_sdk.transfer.data_connection import MAX_SINGLE_PUT_BYTES
from rse_pf.errors import (
    BadRequest,
    Forbidden,
    InternalError,
    LimitExceeded,
    QuotaExceeded,
    RsePfError,
    Unauthorized,
    UsageError,
)
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.slam.cloud_deform import voxel_keys
from rse_pf.slam.keyframe_points import encode_points

__all__ = ["Attachments", "BackgroundUploader", "EncodedAttachments", "StoreObject", "encode_keyframe_points"]

StoreObject = Callable[[bytes], Awaitable[str]]
"""Function that stores bytes as an object of the robot and returns their sha256; it may raise RsePfError."""

_BURST_S = 2.0
"""While no keyframe is made, a byte budget grows to at most this many seconds of its rate; the next keyframes
may spend all of it."""
_BYTES_PER_POINT = 4.5  # mean size of an encoded point after zlib, to turn a byte budget into a point count
_MIN_POINTS = 400  # points of a keyframe (about 2 kB) that are sent even if the byte budget is spent
_JPEG_QUALITY = 85  # JPEG quality, 0 to 100, of the images of keyframes

_MIN_POINT_DEPTH_M = 0.3  # nearer readings of a depth camera are not sent, as in the robot's own cloud
_MAX_POINT_DEPTH_M = 3.5  # farther readings are not sent: a depth camera is off by centimetres there
_VOXEL_M = 0.01  # edge of a voxel: a keyframe sends one point for each, so that near surfaces take few bytes
_MAX_DEPTH_STEP = 0.05
"""Largest difference between the depth of a pixel and that of any of its four neighbours, as a fraction of
its depth.  A pixel with a larger difference is not sent: it lies on the edge of a surface, and its depth may
be a mean of two surfaces."""

_REQUEST_BYTES = 1_000  # bytes of request head, token and answer that the rate limit counts for each object
_MAX_WAITING_BYTES = 16 << 20
"""Most bytes that wait in memory for one `BackgroundUploader`, that of the points or that of the images;
beyond it, the oldest objects are dropped."""
_MAX_QUIET_WAIT_S = 1.0
"""Longest time for which one upload waits for pose queries and keyframes, in seconds; then it is sent in any
case, because a robot that always has some would never upload."""
_FIRST_PAUSE_S = 0.5  # pause after the first failed upload, in seconds; it doubles with each failure in a row
_MAX_PAUSE_S = 30.0  # longest pause after a failed upload, in seconds
_REFUSALS = (BadRequest, Forbidden, LimitExceeded, QuotaExceeded, Unauthorized, UsageError)
"""Errors with which an object would be refused again: it is dropped, and the next one is tried after a
pause."""

_Pixels = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodedAttachments:
    """Attachments of one keyframe as they are stored.

    Attributes:
        points: Coloured points, as `rse_pf.slam.keyframe_points.encode_points` returns them; None if the
            keyframe has none.
        image: Image of the frame as JPEG; None if the keyframe has none.
    """

    points: bytes | None = None
    image: bytes | None = None


class Attachments:
    """Make the attachments of one robot's keyframes, and upload them in the background.

    Points and images have a queue and a rate limit each, so that images, which are larger, do not delay
    points.
    """

    def __init__(
        self,
        store: StoreObject | None,
        options: LiveOptions,
        clock: Callable[[], float],
        wait_quiet: Callable[[], Awaitable[None]],
    ) -> None:
        """Store the arguments; `run` uploads.

        Args:
            store: Stores one object; None means that keyframes have no attachments.
            options: Number of points, whether images are wanted, and the rate limits of both.
            clock: Monotonic time in seconds.
            wait_quiet: Returns once no pose query is open and no keyframe waits; called before each upload.
        """
        self._options, self._clock = options, clock
        self.may_store_images = False
        """Whether the operator allows images of keyframes (``live.images``); `LiveMapper` sets it when the
        map has answered."""
        self._point_uploader = self._image_uploader = None
        if store is not None and options.points > 0:
            self._point_uploader = BackgroundUploader(
                store, bytes_per_s=options.points_bytes_per_s, clock=clock, wait_quiet=wait_quiet
            )
        if store is not None and options.images:
            self._image_uploader = BackgroundUploader(
                store, bytes_per_s=options.images_bytes_per_s, clock=clock, wait_quiet=wait_quiet
            )
        self._point_budget = TokenBucket(
            options.points_bytes_per_s, burst=_BURST_S * options.points_bytes_per_s
        )
        self._image_budget = TokenBucket(
            options.images_bytes_per_s, burst=_BURST_S * options.images_bytes_per_s
        )

    def make(self, frame: Frame, features: Features) -> EncodedAttachments:
        """Encode the points and the image of a keyframe, and take their bytes from the two byte budgets.

        The points are at most as many as `LiveOptions.points` and the budget of the points allow; also a
        budget that is spent allows 400.  There is no image while the budget of the images is spent.  May run
        in any thread.
        """
        points, image, now = None, None, self._clock()
        if self._point_uploader is not None:
            self._point_budget.fill(now)
            affordable_points = int(self._point_budget.tokens / _BYTES_PER_POINT)
            max_points = min(self._options.points, max(affordable_points, _MIN_POINTS))
            points = encode_keyframe_points(frame, features, max_points)
            self._point_budget.spend(len(points or b""), now)
        if self._image_uploader is not None and self.may_store_images:
            self._image_budget.fill(now)
            if self._image_budget.tokens > 0:
                image = _encode_jpeg(frame)
                self._image_budget.spend(len(image or b""), now)
        return EncodedAttachments(points=points, image=image)

    def add(self, encoded: EncodedAttachments) -> None:
        """Add the attachments of a queued keyframe to those that `run` uploads."""
        if self._point_uploader is not None and encoded.points is not None:
            self._point_uploader.add(encoded.points)
        if self._image_uploader is not None and encoded.image is not None:
            self._image_uploader.add(encoded.image)

    async def run(self) -> None:
        """Upload the attachments that `add` was given, until cancelled."""
        await asyncio.gather(*(uploader.run() for uploader in self._uploaders()))

    async def wait_empty(self) -> None:
        """Wait until every attachment was uploaded or dropped."""
        for uploader in self._uploaders():
            await uploader.is_empty.wait()

    def report(self) -> dict[str, Any]:
        """Return the reports of the uploaders in use, under the keys ``points`` and ``images``."""
        image_uploader = self._image_uploader if self.may_store_images else None
        uploaders = {"points": self._point_uploader, "images": image_uploader}
        return {name: uploader.report() for name, uploader in uploaders.items() if uploader is not None}

    def _uploaders(self) -> list[BackgroundUploader]:
        return [uploader for uploader in (self._point_uploader, self._image_uploader) if uploader is not None]


class BackgroundUploader:
    """Upload objects of a robot to the object store, oldest first, at a limited rate and low priority."""

    def __init__(
        self,
        store: StoreObject,
        *,
        bytes_per_s: float,
        clock: Callable[[], float],
        wait_quiet: Callable[[], Awaitable[None]],
    ) -> None:
        """Store the arguments; `run` uploads.

        Args:
            store: Stores one object.  If it raises, the upload is repeated or the object is dropped, as `run`
                says; an exception that is no RsePfError is also written to the log.
            bytes_per_s: Rate limit in bytes per second of the objects, each with 1,000 bytes for its request.
            clock: Monotonic time in seconds.
            wait_quiet: Returns once no pose query is open and no keyframe waits.
        """
        self._sent = 0
        self._sent_bytes = 0
        self._dropped = 0
        self._trouble = ""
        self._store, self._clock, self._wait_quiet = store, clock, wait_quiet
        self._rate_limit = TokenBucket(bytes_per_s, burst=0.0)
        self._callbacks = UserCallbacks()
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self.is_empty = asyncio.Event()
        """Set while every added object was uploaded or dropped."""
        self._has_object = asyncio.Event()
        self.is_empty.set()

    def add(self, data: bytes) -> None:
        """Add an object to upload; while more than 16 MiB wait, the oldest waiting objects are dropped."""
        self._waiting.append(data)
        self._waiting_bytes += len(data)
        while self._waiting_bytes > _MAX_WAITING_BYTES:
            self._waiting_bytes -= len(self._waiting.popleft())
            self._dropped += 1
        self.is_empty.clear()
        self._has_object.set()

    def report(self) -> dict[str, int | str]:
        """Return the numbers of objects ``sent``, ``waiting``, ``dropped``, then ``bytes`` and ``trouble``.

        ``bytes`` is the number of bytes sent, with 1,000 for each request in addition to its object.
        ``trouble`` is the last failure as ``code: sentence``, empty after a success.
        """
        return {
            "sent": self._sent,
            "bytes": self._sent_bytes,
            "waiting": len(self._waiting),
            "dropped": self._dropped,
            "trouble": self._trouble,
        }

    async def run(self) -> None:
        """Upload objects, the oldest first, until cancelled.

        A failed upload is repeated after a pause, and later objects wait for it.  An object that the server
        refuses is dropped.
        """
        pause_s = _FIRST_PAUSE_S
        while True:
            # 1. Wait for an object, for the rate limit, and until no pose query or keyframe waits.
            while not self._waiting:
                self.is_empty.set()
                self._has_object.clear()
                await self._has_object.wait()
            data = self._waiting[0]
            await asyncio.sleep(self._rate_limit.spend(len(data) + _REQUEST_BYTES, self._clock()))
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._wait_quiet(), _MAX_QUIET_WAIT_S)
            # 2. Upload the object.
            try:
                await self._store(data)
            except Exception as error:  # noqa: BLE001  the function may belong to the user's program
                # 3. Record the failure, also one of a user's function; drop a refused object, and pause.
                if not isinstance(error, RsePfError):
                    self._callbacks.report("store", error)
                    error = InternalError(
                        f"store raised {type(error).__name__}", hint="read its traceback in the log"
                    )
                self._trouble = f"{error.code}: {error.message}"
                if isinstance(error, _REFUSALS):
                    self._dropped += self._remove_if_first(data)
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, _MAX_PAUSE_S)
            else:
                self._sent += self._remove_if_first(data)
                self._sent_bytes += len(data) + _REQUEST_BYTES
                self._trouble, pause_s = "", _FIRST_PAUSE_S

    def _remove_if_first(self, data: bytes) -> bool:
        """Remove the oldest object if it is *data*; return False if `add` has dropped *data* meanwhile."""
        is_first = bool(self._waiting) and self._waiting[0] is data
        if is_first:
            self._waiting.popleft()
            self._waiting_bytes -= len(data)
        return is_first


def encode_keyframe_points(frame: Frame, features: Features, max_points: int) -> bytes | None:
    """Choose and encode at most *max_points* coloured points of a keyframe; return None if there are none.

    With a depth image, the points are pixels on a regular grid, row by row from the top, that have a depth of
    0.3 to 3.5 m and do not lie on depth edges.  With a stereo pair, they are the features whose depth is
    known to 5 % (`select_certain_rows`).  In each voxel of 1 cm only the first point stays, and of the rest
    the first *max_points* are encoded; the step of the grid is chosen so that this leaves out few.
    """
    # 1. Choose pixels with a certain depth.
    if frame.stereo is None:
        pixels = _choose_grid_pixels(frame, max_points)
        depths_m = frame.depth_m[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    else:
        rows = select_certain_rows(frame, features)
        last_pixel = np.array([frame.camera.width, frame.camera.height]) - 1
        pixels = np.clip(np.rint(features.pixels[rows]).astype(np.int64), 0, last_pixel)
        depths_m = features.points_camera[rows, 2].astype(np.float64)
    # 2. Keep the first point in each voxel.
    points_camera = frame.camera.back_project(pixels.astype(np.float64), depths_m)
    _, first_in_voxel = np.unique(voxel_keys(points_camera, _VOXEL_M), axis=0, return_index=True)
    chosen = np.sort(first_in_voxel)[:max_points]
    if not len(chosen):
        return None
    # 3. Encode pixels, depths and colours.
    pixels = pixels[chosen]
    return encode_points(pixels, depths_m[chosen], frame.rgb[pixels[:, 1], pixels[:, 0]], frame.camera)


def _choose_grid_pixels(frame: Frame, max_points: int) -> _Pixels:
    """Return ``(n, 2)`` columns and rows of grid pixels whose depth is in range and not on a depth edge.

    The step of the grid is the same along columns and rows, at least 2 px, and large enough that the grid has
    about *max_points* pixels.
    """
    depth = frame.depth_m
    height, width = depth.shape
    step = max(2, math.ceil(math.sqrt(height * width / max_points)))
    grid_rows, grid_columns = np.mgrid[step // 2 : height - 1 : step, step // 2 : width - 1 : step]
    v, u = grid_rows.ravel(), grid_columns.ravel()
    z = depth[v, u]
    with np.errstate(invalid="ignore"):
        is_usable = (z >= _MIN_POINT_DEPTH_M) & (z <= _MAX_POINT_DEPTH_M)
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            is_usable &= np.abs(depth[v + dv, u + du] - z) <= _MAX_DEPTH_STEP * z
    pixels: _Pixels = np.column_stack((u, v))[is_usable].astype(np.int64)
    return pixels


def _encode_jpeg(frame: Frame) -> bytes | None:
    """Encode the image of a frame as JPEG; return None on failure, or above `MAX_SINGLE_PUT_BYTES`."""
    cv2 = load_opencv()
    bgr = np.ascontiguousarray(frame.rgb[:, :, ::-1])
    is_encoded, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes() if is_encoded and data.nbytes <= MAX_SINGLE_PUT_BYTES else None

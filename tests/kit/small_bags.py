"""Small bags for tests: five frames of a scene that moves, written with `BagWriter` as any driver would."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.bags import BagKind, BagWriter
from client_sdk.bags.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POSE, TF
from client_sdk.frontend import load_opencv

WIDTH, HEIGHT, FRAMES = 64, 48, 5
FX, CX, CY = 60.0, 31.5, 23.5
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
KINDS: tuple[BagKind, ...] = ("ros1", "sqlite3", "mcap")
FIRST_KINDS = ("ros1", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("sqlite3", "mcap")))
"""All kinds, of which the default suite tries the one that is written without YAML."""

Message = tuple[str, str, int, Any]
"""Topic, type, time of writing, message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What a small bag shows; ``colours`` and ``depths_mm`` hold one image for each frame."""

    colours: npt.NDArray[np.uint8]
    depths_mm: npt.NDArray[np.uint16]


def scene() -> Scene:
    """Return smooth colours, which JPEG keeps, and depth with holes."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    colours = [
        np.stack((3 * columns + 9 * n, 4 * rows, 2 * (rows + columns)), axis=2).astype(np.uint8) // 2 + 20
        for n in range(FRAMES)
    ]
    depths = [(1000 + 7 * columns + 5 * rows + 100 * n).astype(np.uint16) for n in range(FRAMES)]
    for depth in depths:
        depth[:6, :9] = 0
    return Scene(colours=np.stack(colours), depths_mm=np.stack(depths))


def stamp_of(row: int) -> int:
    """Return the time stamp of a frame, nanoseconds."""
    return START_NS + row * PERIOD_NS


def raw_image(
    w: BagWriter, stamp: int, pixels: npt.NDArray[Any], encoding: str, frame: str = "eye", pad: int = 0
) -> Any:
    """Return an ``Image``; *pad* bytes follow each row."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=99)
    return w.make(
        IMAGE, header=w.header(stamp, frame), height=len(pixels), width=pixels.shape[1], encoding=encoding,
        is_bigendian=int(pixels.dtype.byteorder == ">"), step=rows.shape[1], data=rows.ravel(),
    )  # fmt: skip


def compressed(w: BagWriter, stamp: int, data: bytes, form: str, frame: str = "eye") -> Any:
    """Return a ``CompressedImage``."""
    return w.make(
        COMPRESSED_IMAGE, header=w.header(stamp, frame), format=form, data=np.frombuffer(data, dtype=np.uint8)
    )


def camera_info(
    w: BagWriter, stamp: int, distortion: Sequence[float] = (), model: str = "plumb_bob", frame: str = "eye",
    **other: Any,
) -> Any:  # fmt: skip
    """Return a ``CameraInfo`` of the small camera."""
    roi = w.make(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    fields: dict[str, Any] = {
        "height": HEIGHT, "width": WIDTH, "distortion_model": model, "d": np.array(distortion, dtype=float),
        "k": np.array([FX, 0, CX, 0, FX, CY, 0, 0, 1.0]), "r": np.eye(3).ravel(),
        "p": np.array([FX, 0, CX, 0, 0, FX, CY, 0, 0, 0, 1.0, 0]), "binning_x": 0, "binning_y": 0, "roi": roi,
    }  # fmt: skip
    return w.make(CAMERA_INFO, header=w.header(stamp, frame), **{**fields, **other})


def transforms(
    w: BagWriter,
    stamp: int,
    parent: str,
    child: str,
    position: Sequence[float],
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
) -> Any:
    """Return a ``TFMessage`` with one transform."""
    x, y, z = (float(each) for each in position)
    qx, qy, qz, qw = (float(each) for each in quaternion)
    moved = w.make(
        "geometry_msgs/msg/Transform",
        translation=w.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        rotation=w.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
    one = w.make(
        "geometry_msgs/msg/TransformStamped",
        header=w.header(stamp, parent),
        child_frame_id=child,
        transform=moved,
    )
    return w.make(TF, transforms=[one])


def pose(w: BagWriter, stamp: int, position: Sequence[float]) -> Any:
    """Return a ``PoseStamped`` without rotation."""
    x, y, z = (float(each) for each in position)
    return w.make(
        POSE, header=w.header(stamp, "world"),
        pose=w.make(
            "geometry_msgs/msg/Pose", position=w.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=w.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        ),
    )  # fmt: skip


def raw_frames(w: BagWriter) -> list[Message]:
    """Return the scene as raw images, with cameras and tf."""
    shown = scene()
    found: list[Message] = []
    for row in range(FRAMES):
        stamp = stamp_of(row)
        bgr = shown.colours[row][:, :, ::-1]
        found += [
            ("/camera/color/camera_info", CAMERA_INFO, stamp, camera_info(w, stamp)),
            (COLOUR, IMAGE, stamp, raw_image(w, stamp, bgr, "bgr8", pad=8)),
            (DEPTH, IMAGE, stamp, raw_image(w, stamp, shown.depths_mm[row], "16UC1")),
            ("/tf", TF, stamp, transforms(w, stamp, "world", "eye", (0.1 * row, 0, 0))),
        ]
    return found


def compressed_frames(w: BagWriter) -> list[Message]:
    """Return the scene as PNG colours and compressedDepth."""
    cv2 = load_opencv()
    shown = scene()
    found: list[Message] = []
    for row in range(FRAMES):
        stamp = stamp_of(row)
        colour = cv2.imencode(".png", shown.colours[row][:, :, ::-1])[1].tobytes()
        depth = struct.pack("<iff", 0, 0.0, 0.0) + cv2.imencode(".png", shown.depths_mm[row])[1].tobytes()
        found += [
            ("/camera/color/camera_info", CAMERA_INFO, stamp, camera_info(w, stamp)),
            (f"{COLOUR}/compressed", COMPRESSED_IMAGE, stamp,
             compressed(w, stamp, colour, "bgr8; png compressed bgr8")),
            (f"{DEPTH}/compressedDepth", COMPRESSED_IMAGE, stamp,
             compressed(w, stamp, depth, "16UC1; compressedDepth png")),
        ]  # fmt: skip
    return found


def write_bag(
    folder: Path, kind: BagKind = "ros1", make: Callable[[BagWriter], list[Message]] = raw_frames,
    change: Callable[[BagWriter, list[Message]], list[Message]] = lambda _, messages: messages,
    *, is_compressed: bool = False,
) -> Path:  # fmt: skip
    """Write a small bag into *folder*, its messages changed by *change*; return its path.

    ROS 1 is what tests use that do not ask for a kind: the YAML of ROS 2 takes most of the time of a bag.
    """
    path = folder / ("small.bag" if kind == "ros1" else "small")
    with BagWriter(path, kind, is_compressed=is_compressed) as writer:
        for topic, message_kind, log_ns, message in change(writer, make(writer)):
            if isinstance(message, bytes):
                writer.write_bytes(topic, message_kind, log_ns, message)
            else:
                writer.write(topic, message_kind, log_ns, message)
    return path

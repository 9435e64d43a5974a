"""Write bags without ROS: messages of any topic, and maps as paths and a point cloud.

Existing files are never replaced.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from client_sdk.auto_close import AutoClose
from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import PATH, POINT_CLOUD, POSE, TF
from client_sdk.trajectory import Trajectory
from rse_pf.errors import MissingExtra, UsageError

__all__ = ["BagKind", "BagWriter", "write_map_bag"]

BagKind = Literal["ros1", "sqlite3", "mcap"]
"""Format of a bag: a ROS 1 bag, or a ROS 2 bag that is stored as sqlite3 or MCAP."""
_FILE_ENDINGS = {"sqlite3": ".db3", "mcap": ".mcap"}  # endings of the files of ROS 2 bags


class BagWriter(MessageMaker, AutoClose):
    """Write a new bag, in ``with``, which creates and closes it.

    For ``ros1`` *path* is a ``.bag`` file, for ``sqlite3`` and ``mcap`` the folder of a ROS 2 bag.
    """

    def __init__(self, path: Path, kind: BagKind, *, is_compressed: bool = False) -> None:
        super().__init__(is_ros1=kind == "ros1")
        self.path = path
        self.kind: BagKind = kind
        self._is_compressed = is_compressed
        self._writer: Any = None
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        """Create the bag; raises UsageError if it exists already, or cannot be written."""
        if self.path.exists():
            raise UsageError(f"{self.path} exists already", hint="name another place, or remove it")
        try:
            self._writer = self._new_writer()
            self._writer.open()
        except OSError as error:
            raise UsageError(
                f"cannot write {self.path}: {error.strerror}", hint="name another place"
            ) from error
        return self

    def close(self) -> None:
        """Write the index of the bag, and close its files."""
        self._writer.close()

    def write(self, topic: str, kind: str, log_ns: int, message: Any) -> None:
        """Write a message of the type *kind*; *log_ns* is its time of writing in the bag, nanoseconds."""
        self.write_bytes(topic, kind, log_ns, self.encode(kind, message))

    def write_bytes(self, topic: str, kind: str, log_ns: int, data: bytes) -> None:
        """Write an encoded message of the type *kind*; *log_ns* as in `write`."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.types)
        self._writer.write(self._connections[topic], log_ns, data)

    def _new_writer(self) -> Any:
        try:
            from rosbags.rosbag1 import Writer as Writer1
            from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
            from rosbags.rosbag2 import Writer as Writer2
        except ImportError as error:
            raise MissingExtra("rosbags", "bags") from error
        if self.kind == "ros1":
            one = Writer1(self.path)
            if self._is_compressed:
                one.set_compression(Writer1.CompressionFormat.LZ4)
            return one
        plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(self.path, version=9, storage_plugin=plugin)
        if self._is_compressed:
            mode = CompressionMode.STORAGE if self.kind == "mcap" else CompressionMode.MESSAGE
            writer.set_compression(mode, CompressionFormat.ZSTD)
        return writer


def write_map_bag(
    path: Path,
    kind: BagKind,
    trajectories: Iterable[tuple[str, Trajectory]],
    points: npt.NDArray[np.float32],
    colours: npt.NDArray[np.uint8],
    *,
    frame: str = "map",
) -> int:
    """Write a map as a bag that ROS tools can display, and return the number of its messages.

    Each robot gets a topic of poses, a topic with its path, and transforms in ``/tf``; the points are one
    ``PointCloud2`` with colours.  Times of messages are those of the trajectories.

    Args:
        path: File or folder of the new bag.  If the path has the ending of a file of a ROS 2 bag, only this
            file is written, without a folder.
        kind: Format of the bag.
        trajectories: Names of robots with their trajectories.
        points: ``(n, 3)``, metres.
        colours: ``(n, 3)``, RGB.
        frame: Name of the world frame.

    Raises:
        UsageError: The bag exists, or cannot be written.
        MissingExtra: ``rosbags`` is not installed.
    """
    if path.exists():
        raise UsageError(f"{path} exists already", hint="name another place, or remove it")
    if kind != "ros1" and path.suffix in _FILE_ENDINGS.values():
        # The library writes a folder: write it to a temporary place, and move the file out of it.
        with TemporaryDirectory(prefix=".bag-", dir=path.absolute().parent) as folder:
            whole = Path(folder) / path.stem
            count = _write_map(whole, kind, list(trajectories), points, colours, frame)
            (whole / f"{whole.name}{_FILE_ENDINGS[kind]}").rename(path)
            return count
    return _write_map(path, kind, list(trajectories), points, colours, frame)


def _write_map(
    path: Path,
    kind: BagKind,
    paths: Sequence[tuple[str, Trajectory]],
    points: npt.NDArray[np.float32],
    colours: npt.NDArray[np.uint8],
    frame: str,
) -> int:
    starts = [round(1e9 * float(trajectory.timestamps_s[0])) for _, trajectory in paths if len(trajectory)]
    ends = [round(1e9 * float(trajectory.timestamps_s[-1])) for _, trajectory in paths if len(trajectory)]
    count = 0
    with BagWriter(path, kind) as writer:
        events = []
        for name, recorded in paths:
            topic = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name)
            stamps = [round(1e9 * float(stamp)) for stamp in recorded.timestamps_s]
            poses = [
                writer.pose(stamp, frame, T) for stamp, T in zip(stamps, recorded.T_world_camera, strict=True)
            ]
            for stamp, T, pose in zip(stamps, recorded.T_world_camera, poses, strict=True):
                moved = writer.transform(stamp, frame, f"{topic}_camera", T)
                events.append((stamp, f"/{topic}/pose", POSE, pose))
                events.append((stamp, "/tf", TF, writer.make(TF, transforms=[moved])))
            if stamps:
                whole = writer.path_of(stamps[-1], frame, poses)
                events.append((stamps[-1], f"/{topic}/path", PATH, whole))
        end_ns = max(ends, default=0)
        cloud = writer.cloud(end_ns, frame, points, colours)
        events.append((max(end_ns, min(starts, default=0)), "/map", POINT_CLOUD, cloud))
        for stamp, topic, message_kind, message in sorted(events, key=lambda each: each[0]):
            writer.write(topic, message_kind, stamp, message)
            count += 1
    return count

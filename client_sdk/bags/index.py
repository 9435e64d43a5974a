"""What a bag holds, found by reading it once: time stamps, broken images, transforms and poses.

Images are checked but not decoded, and none is kept: memory grows by 16 bytes for an image, and by 64 for a
sample of an IMU.
"""

from __future__ import annotations

import bisect
import itertools
from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.bags.bag_file import BagFile, BrokenMessage
from client_sdk.bags.choose import ChosenTopics
from client_sdk.bags.images import ImageFormat, check_image
from client_sdk.bags.imu import ImuReadings
from client_sdk.bags.lens import numbers_of
from client_sdk.bags.poses import PoseTopic, TransformTree

__all__ = ["BagIndex", "CameraTimes", "ImageStamps", "read_index"]

Stamps = npt.NDArray[np.int64]


_MAX_STEP_MISMATCH = 0.5
"""Of a step: the latency of the messages after it may differ from the step by so much of it."""


@dataclass(slots=True)
class ImageStamps:
    """Of the good images of a topic: ``stamps_ns`` ascending, as in the messages, and when each was written.

    ``stamps_ns`` go on where the clock was set back by ``clock_step_ns`` in the drive; ``header_ns`` are
    those of the messages.  ``unstamped`` messages had the stamp 0 among others that have one.
    """

    stamps_ns: Stamps
    header_ns: Stamps
    log_ns: Stamps
    was_in_order: bool
    copies: int
    unstamped: int = 0
    clock_step_ns: int = 0


@dataclass(slots=True, eq=False)
class BagIndex:
    """What one pass over a bag found; ``broken`` messages were left out, ``ended`` says why it stopped.

    ``second`` are the images of depth or of the right camera; those of the colours where there is neither.
    """

    colour: ImageStamps
    second: ImageStamps
    tree: TransformTree
    poses: PoseTopic
    imu: ImuReadings
    broken: int = 0
    first_broken: str = ""
    ended: str = ""
    uses_log_time: bool = False
    cameras: dict[str, CameraTimes] = field(default_factory=dict)


@dataclass(slots=True)
class CameraTimes:
    """The ``CameraInfo`` messages of a topic that differ, and which of them was valid when."""

    messages: list[Any] = field(default_factory=list)
    _rows: dict[int, int] = field(default_factory=dict)
    _log_ns: list[int] = field(default_factory=list)
    _logged: list[int] = field(default_factory=list)

    def add(self, message: Any, stamp_ns: int, log_ns: int) -> None:
        """Add a message, which may be equal to one before."""
        numbers = _numbers_of_camera(message)
        known = [_numbers_of_camera(each) for each in self.messages]
        row = known.index(numbers) if numbers in known else len(known)
        if row == len(known):
            self.messages.append(message)
        self._rows[stamp_ns] = row
        self._log_ns.append(log_ns)
        self._logged.append(row)

    def row_at(self, stamp_ns: int, log_ns: int) -> int:
        """Return the row of the message of an image: that of its stamp, or the last one before it."""
        if len(self.messages) < 2:
            return 0
        if stamp_ns in self._rows:
            return self._rows[stamp_ns]
        return self._logged[max(0, bisect.bisect_right(self._log_ns, log_ns) - 1)]


def _numbers_of_camera(message: Any) -> tuple[Any, ...]:
    roi = message.roi
    return (
        message.width, message.height, message.binning_x, message.binning_y, message.distortion_model,
        roi.x_offset, roi.y_offset, roi.width, roi.height,
        *(numbers_of(message, name).tobytes() for name in "dkrp"),
    )  # fmt: skip


@dataclass(slots=True)
class _Collected:
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    log_ns: array[int] = field(default_factory=lambda: array("q"))

    def finish(self, *, use_log_time: bool) -> ImageStamps:
        log_ns = np.array(self.log_ns, dtype=np.int64)
        header_ns = log_ns if use_log_time else np.array(self.stamps_ns, dtype=np.int64)
        is_stamped = header_ns != 0
        header_ns, log_ns = header_ns[is_stamped], log_ns[is_stamped]
        stamps_ns, clock_step_ns = _continued(header_ns, log_ns)
        unique, rows = np.unique(stamps_ns, return_index=True)
        return ImageStamps(
            stamps_ns=unique,
            header_ns=header_ns[rows],
            log_ns=log_ns[rows],
            was_in_order=bool(np.all(np.diff(stamps_ns) >= 0)),
            copies=len(stamps_ns) - len(unique),
            unstamped=int(np.count_nonzero(~is_stamped)),
            clock_step_ns=clock_step_ns,
        )


def _continued(header_ns: Stamps, log_ns: Stamps) -> tuple[Stamps, int]:
    """Return stamps that go on where the clock was set back, and by how much it was in all.

    A clock that is set back makes all later messages look late by the step.  Messages that were only written
    in another order keep their latency, and so keep their stamps.
    """
    latency_ns = log_ns - header_ns
    steps = np.flatnonzero(np.diff(header_ns) < 0) + 1
    parts = np.split(latency_ns, steps)
    shift_ns = np.cumsum([0, *(np.median(b) - np.median(a) for a, b in itertools.pairwise(parts))])
    stamps_ns = header_ns + np.repeat(shift_ns, [len(part) for part in parts]).astype(np.int64)
    backs_ns = header_ns[steps - 1] - header_ns[steps]
    is_clock = np.all(np.diff(shift_ns) > _MAX_STEP_MISMATCH * backs_ns) and np.all(np.diff(stamps_ns) > 0)
    return (stamps_ns, int(shift_ns[-1])) if is_clock and len(steps) else (header_ns, 0)


def read_index(file: BagFile, chosen: ChosenTopics, formats: dict[str, ImageFormat]) -> BagIndex:
    """Read the bag once, and return what it holds of the chosen topics."""
    images = {chosen.colour.name: _Collected()}
    if chosen.second is not None:
        images[chosen.second.name] = _Collected()
    tree, poses, broken, first_broken, ended = TransformTree(), PoseTopic(), 0, "", ""
    pose_topic = None if chosen.poses is None else chosen.poses.name
    imu, imu_topic = ImuReadings(), None if chosen.imu is None else chosen.imu.name
    cameras = {name: CameraTimes() for name in chosen.infos}
    names = {*images, *cameras, *chosen.tf, *(each for each in (pose_topic, imu_topic) if each is not None)}
    messages = file.messages(names)
    while True:
        try:
            raw = next(messages, None)
        except BrokenMessage as error:
            ended = str(error)
            break
        if raw is None:
            break
        try:
            message: Any = file.parse(raw)
            if raw.topic in images:
                check_image(message, formats[raw.topic])
                images[raw.topic].stamps_ns.append(file.stamp_ns(raw))
                images[raw.topic].log_ns.append(raw.log_ns)
            elif raw.topic in cameras:
                cameras[raw.topic].add(message, file.stamp_ns(raw), raw.log_ns)
            elif raw.topic == imu_topic:
                imu.add(message, file.stamp_ns(raw), raw.log_ns)
            elif raw.topic == pose_topic:
                poses.add(message)
            else:
                tree.add(message, is_static="static" in raw.topic)
        except BrokenMessage as error:
            broken += 1
            first_broken = first_broken or f"{raw.topic}: {error}"
    # Some drivers leave the stamps at 0; then the time of writing is all that both have.
    no_stamps = any(not any(image.stamps_ns) for image in images.values())
    stamps = [image.finish(use_log_time=no_stamps) for image in images.values()]
    return BagIndex(
        colour=stamps[0],
        second=stamps[-1],
        tree=tree,
        poses=poses,
        imu=imu,
        broken=broken,
        first_broken=first_broken,
        ended=ended,
        uses_log_time=no_stamps,
        cameras=cameras,
    )

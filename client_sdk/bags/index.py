"""Read a bag once, and collect time stamps, transforms, poses, IMU samples and the number of broken messages.

Images are checked, but neither decoded nor kept: memory grows by 16 bytes for each image, and by 64 bytes for
each sample of the IMU.
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
"""Largest difference between a step back of the time stamps and the change of the latency there, as a share
of the step, at which the clock counts as set back."""


@dataclass(slots=True)
class ImageStamps:
    """The times of the valid images of a topic, nanoseconds, sorted by time stamp.

    Attributes:
        stamps_ns: ``(n,)``, ascending time stamps, continued where the clock was set back.
        header_ns: ``(n,)``, time stamps in the messages.
        log_ns: ``(n,)``, times of writing to the bag.
        was_in_order: Whether the stamps ascended in the order of the bag.
        copies: Number of images that were left out because another image has the same stamp.
        unstamped: Number of images that were left out because their stamp is 0.
        clock_step_ns: Total time, nanoseconds, by which the clock of the stamps was set back; 0 if never.
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
    """The result of reading a bag once.

    Attributes:
        colour: Times of the colour or left images.
        second: Times of the depth or right images; the same as *colour* without such images.
        tree: The frames of tf.
        poses: The poses of the chosen topic.
        imu: The samples of the IMU.
        broken: Number of malformed messages, which were left out.
        first_broken: Topic and error of the first malformed message.
        ended: Why the bag could not be read to its end; "" if it was read to its end.
        uses_log_time: Whether times of writing replace the stamps, since all stamps of a topic are 0.
        cameras: The ``CameraInfo`` messages by name of the topic.
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
    """The different ``CameraInfo`` messages of a topic, in ``messages``, and when each of them is valid."""

    messages: list[Any] = field(default_factory=list)
    _rows: dict[int, int] = field(default_factory=dict)
    _log_ns: list[int] = field(default_factory=list)
    _logged: list[int] = field(default_factory=list)

    def add(self, message: Any, stamp_ns: int, log_ns: int) -> None:
        """Add a message with its stamp and time of writing, ns; equal messages are kept once."""
        numbers = _numbers_of_camera(message)
        known = [_numbers_of_camera(each) for each in self.messages]
        row = known.index(numbers) if numbers in known else len(known)
        if row == len(known):
            self.messages.append(message)
        self._rows[stamp_ns] = row
        self._log_ns.append(log_ns)
        self._logged.append(row)

    def row_at(self, stamp_ns: int, log_ns: int) -> int:
        """Return the index in ``messages`` of the message that is valid for an image.

        This is the message with the stamp of the image, or otherwise the last message that was written before
        the image.
        """
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
class _ImageTimes:
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    log_ns: array[int] = field(default_factory=lambda: array("q"))

    def finish(self, *, use_log_time: bool) -> ImageStamps:
        log_ns = np.array(self.log_ns, dtype=np.int64)
        header_ns = log_ns if use_log_time else np.array(self.stamps_ns, dtype=np.int64)
        is_stamped = header_ns != 0
        header_ns, log_ns = header_ns[is_stamped], log_ns[is_stamped]
        stamps_ns, clock_step_ns = _continue_stamps(header_ns, log_ns)
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


def _continue_stamps(header_ns: Stamps, log_ns: Stamps) -> tuple[Stamps, int]:
    """Continue the time stamps where the clock was set back; return them, and the sum of the steps, ns.

    If the clock is set back, the latency from stamp to writing grows by the step in all later messages.  If
    the latency does not grow, the messages were only written in another order; then the stamps stay as they
    are, and the sum is 0.
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
    """Read the chosen topics of a bag once; *formats* are the formats of the image topics by name."""
    images = {chosen.colour.name: _ImageTimes()}
    if chosen.second is not None:
        images[chosen.second.name] = _ImageTimes()
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
    # Some drivers leave all stamps at 0; then the times of writing are used for both topics of images.
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

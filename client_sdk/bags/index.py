"""What a bag holds, found by reading it once: time stamps, broken images, transforms and poses.

Images are checked but not decoded, and none is kept: memory grows by 16 bytes for an image, and by 64 for a
sample of an IMU.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.bags.bag_file import BagFile, BrokenMessage
from client_sdk.bags.choose import ChosenTopics
from client_sdk.bags.images import ImageFormat, check_image
from client_sdk.bags.imu import ImuReadings
from client_sdk.bags.poses import PoseTopic, TransformTree

__all__ = ["BagIndex", "ImageStamps", "nearest_gap_s", "pair_stamps", "read_index"]

Stamps = npt.NDArray[np.int64]
_Times = npt.NDArray[Any]
"""Of one unit, in whole numbers or not."""


@dataclass(slots=True)
class ImageStamps:
    """Of the good images of a topic: ``stamps_ns`` ascending, and when each was written to the bag."""

    stamps_ns: Stamps
    log_ns: Stamps
    was_in_order: bool
    copies: int


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


@dataclass(slots=True)
class _Collected:
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    log_ns: array[int] = field(default_factory=lambda: array("q"))

    def finish(self, *, use_log_time: bool) -> ImageStamps:
        log_ns = np.array(self.log_ns, dtype=np.int64)
        stamps_ns = log_ns if use_log_time else np.array(self.stamps_ns, dtype=np.int64)
        unique, rows = np.unique(stamps_ns, return_index=True)
        return ImageStamps(
            stamps_ns=unique,
            log_ns=log_ns[rows],
            was_in_order=bool(np.all(np.diff(stamps_ns) >= 0)),
            copies=len(stamps_ns) - len(unique),
        )


def read_index(file: BagFile, chosen: ChosenTopics, formats: dict[str, ImageFormat]) -> BagIndex:
    """Read the bag once, and return what it holds of the chosen topics."""
    images = {chosen.colour.name: _Collected()}
    if chosen.second is not None:
        images[chosen.second.name] = _Collected()
    tree, poses, broken, first_broken, ended = TransformTree(), PoseTopic(), 0, "", ""
    pose_topic = None if chosen.poses is None else chosen.poses.name
    imu, imu_topic = ImuReadings(), None if chosen.imu is None else chosen.imu.name
    names = {*images, *chosen.tf, *(each for each in (pose_topic, imu_topic) if each is not None)}
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
            elif raw.topic == imu_topic:
                imu.add(message, file.stamp_ns(raw), raw.log_ns)
            elif raw.topic == pose_topic:
                poses.add(message)
            else:
                tree.add(message, is_static="static" in raw.topic)
        except BrokenMessage as error:
            broken += 1
            first_broken = first_broken or f"{raw.topic}: {error}"
    # Some drivers leave the stamps at 0; then the time of writing is all there is.
    no_stamps = all(not any(image.stamps_ns) for image in images.values())
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
    )


def pair_stamps(first: _Times, second: _Times, within: float) -> list[tuple[int, int]]:
    """Return ``(row of first, row of second)``, nearest in time, each row at most once; both must ascend."""
    if not len(first) or not len(second):
        return []
    nearest = _nearest(first, second)
    apart = np.abs(second[nearest] - first)
    best: dict[int, tuple[float, int]] = {}
    for row in np.flatnonzero(apart <= within):
        partner = int(nearest[row])
        if partner not in best or apart[row] < best[partner][0]:
            best[partner] = (apart[row], int(row))
    return sorted((row, partner) for partner, (_, row) in best.items())


def nearest_gap_s(first: Stamps, second: Stamps) -> float:
    """Return the smallest time between a stamp of one and a stamp of the other, seconds."""
    return float(np.abs(second[_nearest(first, second)] - first).min()) / 1e9


def _nearest(first: _Times, second: _Times) -> Stamps:
    """Return for each of *first* the row of the nearest of *second*."""
    after = np.minimum(np.searchsorted(second, first), len(second) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(first - second[before]) <= np.abs(second[after] - first), before, after)

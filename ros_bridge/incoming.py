"""Turn the bytes of image messages into frames: paired by time stamp, undistorted, with depth in metres.

Queues are bounded, and adding a message never waits: images that do not fit are counted in
`IncomingFrames.check`. The time of a frame is the time stamp that the driver of the camera set, never the
time of arrival.
"""

from __future__ import annotations

import bisect
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from client_sdk.bags.bag_file import BrokenMessage
from client_sdk.bags.images import ImageFormat, check_image, decode_colour, decode_depth, format_of
from client_sdk.bags.lens import lens_of
from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    ODOMETRY,
    POSE_WITH_COVARIANCE,
    TF,
)
from client_sdk.cameras.source import make_empty_depth
from client_sdk.frontend import Frame, load_opencv
from client_sdk.image_map import ImageMap, map_to_pinhole
from client_sdk.source_facts import MAX_MEDIAN_DEPTH_M, MIN_MEDIAN_DEPTH_M, median_depth_m
from ros_bridge.input_check import InputCheck
from ros_bridge.options import BridgeOptions
from ros_bridge.rig_topics import RigTopics
from rse_pf.errors import RsePfError
from rse_pf.geometry import Camera, Lens

__all__ = ["TOO_FAST", "IncomingFrames", "PairedImages", "Role", "kind_of"]

Role = Literal[
    "colour", "depth", "right", "info", "right_info", "imu", "odometry", "tf", "tf_static", "initialpose"
]
_FRAME_KINDS = {"odometry": ODOMETRY, "tf": TF, "tf_static": TF, "initialpose": POSE_WITH_COVARIANCE}
# Exceptions that decoding of a malformed message may raise.
_FAULTS = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
# A time stamp this far before the last frame, in ns, means that the clock was set back or a bag plays again.
_JUMP_NS = 1_000_000_000
_INFOS: tuple[Role, ...] = ("info", "right_info")
# Number of camera_infos with different lenses that are stored: images that wait are not older than these.
_MAX_CAMERAS = 10
_REPEATED = "repeated"
# The partner of a colour image as text for the user, by role.
_NAMES = {"depth": "depth", "right": "right image"}
# Why an image that does not fit into the queue is left out: the key of the count, and the sentence.
TOO_FAST = ("too fast", "they come faster than they are tracked")
# Largest number of images of a topic that wait for their partner.
_WAITING = 30


def kind_of(role: Role, topic: str) -> str:
    """Return the ROS 2 name of the message type of *topic*, by its *role* and the end of its name.

    Images are compressed if the name ends with ``compressed`` or ``compressedDepth``.
    """
    if role in _FRAME_KINDS:
        return _FRAME_KINDS[role]
    if role == "imu":
        return IMU
    if role in ("info", "right_info"):
        return CAMERA_INFO
    return COMPRESSED_IMAGE if topic.rstrip("/").endswith(("compressed", "compressedDepth")) else IMAGE


def _cause(error: Exception) -> str:
    """Return the message of *error* without its hint, since hints are about bags."""
    return error.message if isinstance(error, RsePfError) else str(error)


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


class _RepeatedImage(BrokenMessage):
    """An image has the same bytes as the previous image of its topic."""


@dataclass(frozen=True, slots=True)
class _StatedCamera:
    """A camera_info that is valid from ``stamp_ns`` on.

    ``rectified`` is the pinhole camera of the first camera_info, to which ``rectifier`` maps images of
    ``lens``; ``change`` says how the lens differs from the first one, and is empty if it does not.
    """

    stamp_ns: int
    lens: Lens
    rectified: Camera
    rectifier: ImageMap
    change: str


def _change_of(topic: str, first: Lens, lens: Lens) -> str:
    """Return a sentence with the numbers of a camera_info that changed from *first* to *lens*.

    Raises:
        BrokenMessage: The size of the images changed.
    """
    pairs = {
        name: (getattr(first.camera, name), getattr(lens.camera, name))
        for name in ("width", "height", "fx", "fy", "cx", "cy")
    }
    pairs |= {name: (getattr(first, name), getattr(lens, name)) for name in ("distortion", "model")}
    changed = ", ".join(f"{name} {old} to {new}" for name, (old, new) in pairs.items() if old != new)
    line = f"{topic} has changed: {changed}"
    if "width" in changed or "height" in changed:
        raise BrokenMessage(line)
    return line


@dataclass(frozen=True, slots=True)
class PairedImages:
    """The messages of one frame, with its time stamp (ns) and the name of the camera's coordinate frame.

    ``partner`` is the depth image or the right image that belongs to ``colour``; None if the bridge has
    neither.
    """

    stamp_ns: int
    camera_frame: str
    colour: Any
    partner: Any


class IncomingFrames:
    """Pairs the images of two topics into frames.

    Any thread may `add`; one other thread calls `take` and `decode`.  ``rig`` holds the calibration of a pair
    and the IMU samples; ``check`` counts unused images with the reasons; ``received`` counts messages by
    role.
    """

    def __init__(
        self,
        maker: MessageMaker,
        options: BridgeOptions,
        why_full: Callable[[], tuple[str, str]] = lambda: TOO_FAST,
    ) -> None:
        """Read the file of the rig, if the options name one.

        Args:
            maker: Decodes the messages.
            options: Topics and limits.
            why_full: Returns the reason and the sentence for an image that does not fit into the queue.

        Raises:
            UsageError: The file of the rig cannot be used.
        """
        self.check = InputCheck()
        self._why_full = why_full
        self.received: Counter[str] = Counter({"colour": 0, "depth": 0, "info": 0})
        self.rig = RigTopics(options)
        self._maker, self._options = maker, options
        self._bound_ns = round(1e9 * options.pair_within_s)
        self._partner = options.partner
        roles: tuple[Role, ...] = ("colour", "depth", "right", "info", "right_info", "imu")
        self._kinds = {role: kind_of(role, str(getattr(options, role))) for role in roles}
        self._lock = threading.Lock()
        self._waiting: dict[str, list[tuple[int, Any]]] = {"colour": [], "depth": [], "right": []}
        self._formats: dict[str, ImageFormat] = {}
        self._ready: deque[PairedImages] = deque()
        self._last_ns = -1
        self._jump_ns = 0
        self._stragglers: Counter[str] = Counter()
        self._cameras: deque[_StatedCamera] = deque(maxlen=_MAX_CAMERAS)
        self._first_lenses: dict[Role, Lens] = {}
        self._unusable_infos: dict[Role, str] = {}
        self._newest_ns: dict[str, int] = {}
        self._last_pixels: dict[str, Any] = {}

    def add(self, role: Role, data: bytes | memoryview) -> bool:
        """Decode and store a message of the topic *role*; return whether a frame became ready for `take`.

        A message that cannot be used is counted in ``check``; no error is raised.
        """
        with self._lock:
            self.received[role] += 1
            if role == "colour":
                self.check.count_colour()
            try:
                message = self._maker.decode(self._kinds[role], data)
                if role in _INFOS:
                    self._learn_camera(role, message)
                    self._unusable_infos.pop(role, None)
                    return False
                if role == "imu":
                    waited = self._waits_for_imu()
                    self.rig.add_imu(message, _stamp_ns(message))
                    return waited and not self._waits_for_imu()
                self._check(role, message)
            except (BrokenMessage, RsePfError, *_FAULTS) as error:
                fault = f"a message of {self._topic(role)} cannot be used: {_cause(error)}"
                if role in _INFOS:
                    self._unusable_infos[role] = fault
                self.check.refuse("broken", fault)
                return False
            stamp_ns = _stamp_ns(message)
            if self._is_stamp_wrong(role, stamp_ns):
                return False
            if stamp_ns < self._last_ns - _JUMP_NS:
                self._begin_again(role, stamp_ns)
            elif self._is_straggler(role, stamp_ns):
                self._leave_out("before the clock jumped back", role)
                return False
            elif stamp_ns <= self._last_ns:
                self._leave_out("too late", role)
                return False
            bisect.insort(self._waiting[role], (stamp_ns, message), key=lambda each: each[0])
            if len(self._waiting[role]) > _WAITING:
                del self._waiting[role][0]
                self._leave_out("without partner", role, self._no_partner)
            before = len(self._ready)
            self._pair()
            return len(self._ready) > before

    def take(self) -> PairedImages | None:
        """Return the oldest frame that is ready; None if there is none, or if it waits for an IMU sample."""
        with self._lock:
            return self._ready.popleft() if self._ready and not self._waits_for_imu() else None

    def decode(self, images: PairedImages, *, keeps_repeated: bool = False) -> Frame | None:
        """Decode *images* and return the undistorted frame; None if they cannot be used.

        ``check`` counts the frames that are left out and reports why.  An image that repeats the one before
        is left out; with *keeps_repeated* it is reported but used, for a mapper with wheel odometry.
        An image of a camera_info other than the first one is mapped to the camera of the first one.
        """
        try:
            stated = self._camera_at(images.stamp_ns)
            wanted, rectifier = stated.rectified, stated.rectifier
            if repeated := self._find_repeated(images):
                if not keeps_repeated:
                    raise _RepeatedImage(repeated)
                with self._lock:
                    self.check.note(repeated)
            rgb = decode_colour(images.colour)
            if rgb.shape[:2] != (wanted.height, wanted.width):
                raise BrokenMessage(
                    f"images of {rgb.shape[1]}x{rgb.shape[0]} px do not fit the camera_info of "
                    f"{wanted.width}x{wanted.height} px"
                )
            with self._lock:
                samples = self.rig.imu_until(images.stamp_ns)
            made = Frame(
                timestamp_s=images.stamp_ns / 1e9, rgb=rgb, depth_m=make_empty_depth(wanted), camera=wanted,
                imu=samples, T_body_camera=self.rig.T_body_camera,
            )  # fmt: skip
            if self._partner == "right":
                return self._pair_of(made, images.partner)
            if images.partner is not None:
                depth_m = decode_depth(images.partner, self._options.depth_scale)
                if depth_m.shape != rgb.shape[:2]:
                    raise BrokenMessage(f"depth on {self._topic('depth')} is not registered to the colours")
                self._refuse_other_unit(depth_m)
                made = replace(made, depth_m=rectifier.depth(depth_m))
            if stated.change:
                with self._lock:
                    self.check.note(f"{stated.change}; images are mapped to the first camera")
            return replace(made, rgb=rectifier.colour(rgb))
        except (BrokenMessage, RsePfError, *_FAULTS) as error:
            with self._lock:
                self.check.refuse(_REPEATED if isinstance(error, _RepeatedImage) else "broken", _cause(error))
            return None

    def _camera_at(self, stamp_ns: int) -> _StatedCamera:
        """Return the newest camera_info that is not later than *stamp_ns*, or the oldest one.

        Raises:
            BrokenMessage: No camera_info was received, or the newest one cannot be used.
        """
        with self._lock:
            for fault in self._unusable_infos.values():
                raise BrokenMessage(fault)
            if not self._cameras:
                raise BrokenMessage(f"no camera_info came on {self._topic('info')}")
            newest_first = reversed(self._cameras)
            return next((each for each in newest_first if each.stamp_ns <= stamp_ns), self._cameras[0])

    def _topic(self, role: str) -> str:
        return self._options.named(str(getattr(self._options, role)))

    def _leave_out(self, reason: str, role: str, sentence: str = "") -> None:
        is_colour = role == "colour"
        self.check.leave_out(reason, sentence=sentence, colours=is_colour, partners=not is_colour)

    @property
    def _no_partner(self) -> str:
        name = _NAMES[self._partner or "depth"]
        return f"colours have no {name} within {self._options.pair_within_s:g} s"

    def _is_stamp_wrong(self, role: Role, stamp_ns: int) -> bool:
        """Return whether the time stamp of an image is not set, or equals that of the topic's previous image.

        Such an image is counted in ``check`` as invalid.
        """
        before_ns, self._newest_ns[role] = self._newest_ns.get(role), stamp_ns
        if stamp_ns <= 0:
            fault = "header.stamp is not set"
        elif stamp_ns == before_ns:
            fault = f"header.stamp stands still at {stamp_ns / 1e9:.3f} s"
        else:
            return False
        self.check.refuse("stamp", f"images of {self._topic(role)} cannot be put in order: {fault}")
        return True

    def _find_repeated(self, images: PairedImages) -> str:
        """Return a sentence if an image has the bytes of its topic's previous one: the camera is frozen.

        Otherwise the text is empty.

        The noise of a working camera changes the bytes even if the camera is stationary.  Depth images, and
        images with a single brightness, are not checked, since they may be the same for a moving camera.
        """
        for role, message in (("colour", images.colour), ("right", images.partner)):
            if role not in ("colour", self._partner):
                continue
            pixels = np.asarray(message.data)
            before, self._last_pixels[role] = self._last_pixels.get(role), pixels
            if before is not None and np.array_equal(before, pixels) and np.ptp(pixels):
                return f"{self._topic(role)} repeats an image with a new stamp: its camera is frozen"
        return ""

    def _refuse_other_unit(self, depth_m: Any) -> None:
        median_m = median_depth_m([depth_m])
        if median_m is not None and not MIN_MEDIAN_DEPTH_M <= median_m <= MAX_MEDIAN_DEPTH_M:
            raise BrokenMessage(
                f"the median depth of {self._topic('depth')} is {median_m:g} m, not within "
                f"{MIN_MEDIAN_DEPTH_M:g}..{MAX_MEDIAN_DEPTH_M:g} m: 32FC1 is in metres, and 16UC1 has "
                f"depth_scale = {self._options.depth_scale:g} units a metre"
            )

    def _waits_for_imu(self) -> bool:
        """Return whether the only ready frame waits for an IMU sample after it."""
        return len(self._ready) == 1 and self.rig.is_imu_due(self._ready[0].stamp_ns)

    def _pair_of(self, left: Frame, right: Any) -> Frame:
        """Return the rectified stereo frame of the decoded frame *left* and the message *right*.

        Raises:
            BrokenMessage: The camera_info of the right camera was not received.
        """
        rectification = self.rig.rectification
        if rectification is None:
            raise BrokenMessage(f"no camera_info came on {self._topic('right_info')}")
        gray = load_opencv().cvtColor(decode_colour(right), load_opencv().COLOR_RGB2GRAY)
        return replace(
            left, rgb=rectification.left(left.rgb), camera=rectification.camera,
            stereo=rectification.right(gray),
        )  # fmt: skip

    def _begin_again(self, role: Role, stamp_ns: int) -> None:
        """After the clock was set back to *stamp_ns*, drop the waiting images and accept earlier time stamps.

        The next images of the other topics, 30 at most, may still be from before the jump.
        """
        self._jump_ns = stamp_ns
        self._stragglers = Counter(dict.fromkeys(self._waiting, _WAITING))
        self._stragglers[role] = 0
        for name, waiting in self._waiting.items():
            for _ in waiting:
                self._leave_out("before the clock jumped back", name)
            waiting.clear()
        self._last_ns = -1

    def _is_straggler(self, role: Role, stamp_ns: int) -> bool:
        """Return whether an image is from before the clock was set back; such an image must not be used.

        Its time stamp would make all following images too late.
        """
        if not self._stragglers[role]:
            return False
        is_old = stamp_ns > self._jump_ns + _JUMP_NS // 2
        self._stragglers[role] = self._stragglers[role] - 1 if is_old else 0
        return is_old

    def _learn_camera(self, role: Role, message: Any) -> None:
        """Store the camera_info *message* of the camera *role*.

        A pair is rectified only once, so that a change of its cameras is an error; the file of a rig has
        priority over the camera_infos of a pair.

        Raises:
            BrokenMessage: The camera_info cannot be used, its image size changed, or a camera of a pair
                changed.
        """
        self.rig.learn(role, message)
        if role == "right_info" and self._options.rig:
            return
        images = self._options.colour if role == "info" else self._options.right
        lens = lens_of(message, self._topic(role), is_rectified="rect" in images.rsplit("/", 1)[-1])
        first = self._first_lenses.setdefault(role, lens)
        change = "" if lens == first else _change_of(self._topic(role), first, lens)
        is_pair = self._partner == "right"
        if change and is_pair and not self._options.rig:
            raise BrokenMessage(f"{change}; a pair is rectified once: start the bridge again")
        if role == "info" and (not self._cameras or (self._cameras[-1].lens != lens and not is_pair)):
            rectifier = map_to_pinhole(lens, first.camera)
            self._cameras.append(_StatedCamera(_stamp_ns(message), lens, first.camera, rectifier, change))

    def _check(self, role: Role, message: Any) -> None:
        """Raise BrokenMessage if an image is incomplete, or differs in format from the topic's first one."""
        if role not in self._formats:
            image_format = format_of(message, self._kinds[role])
            wanted = "depth" if role == "depth" else "colour"
            if image_format.holds != wanted:
                holds = (
                    f"holds {image_format.holds}"
                    if image_format.holds
                    else f"has the encoding {image_format.encoding}"
                )
                raise BrokenMessage(f"it {holds}, where {wanted} is expected")
            self._formats[role] = image_format
        check_image(message, self._formats[role])

    def _pair(self) -> None:
        """Pair each waiting colour image with the partner nearest in time, and make the frames ready.

        A colour image waits as long as a nearer partner may still arrive.
        """
        colours, partners = self._waiting["colour"], self._waiting[self._partner or "depth"]
        while colours:
            stamp_ns, colour = colours[0]
            if not self._partner:
                self._make_ready(stamp_ns, colour, None)
                del colours[0]
                continue
            if not partners:
                return
            nearest = min(range(len(partners)), key=lambda row: abs(partners[row][0] - stamp_ns))
            gap_ns = abs(partners[nearest][0] - stamp_ns)
            may_come = partners[-1][0] < stamp_ns + (gap_ns if gap_ns <= self._bound_ns else self._bound_ns)
            if may_come and gap_ns:
                return  # a nearer one may still arrive
            del colours[0]
            if gap_ns > self._bound_ns:
                self._leave_out("without partner", "colour", self._no_partner)
                continue
            self._make_ready(stamp_ns, colour, partners[nearest][1])
            self.check.leave_out("without partner", colours=0, partners=nearest)
            del partners[: nearest + 1]

    def _make_ready(self, stamp_ns: int, colour: Any, partner: Any) -> None:
        frame = self._options.camera_frame or str(colour.header.frame_id).lstrip("/") or "camera"
        self._ready.append(PairedImages(stamp_ns, frame, colour, partner))
        self._last_ns = stamp_ns
        if len(self._ready) > self._options.queue_frames:
            self._ready.popleft()
            self.check.leave_out(*self._why_full())

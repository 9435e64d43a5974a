"""From the bytes of image messages to frames: paired by their time stamps, undistorted, with depth in metres.

It never waits and never grows: what does not fit is counted in `IncomingFrames.left_out`.  The time of a
frame is the stamp that the camera's driver gave, never the time of arrival.
"""

from __future__ import annotations

import bisect
import threading
from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Any, Literal

from client_sdk.bags.bag_file import BrokenMessage
from client_sdk.bags.images import ImageFormat, check_image, decode_colour, decode_depth, format_of
from client_sdk.bags.lens import Rectifier, lens_of
from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, IMU
from client_sdk.cameras.source import no_depth
from client_sdk.frontend import Frame, load_opencv
from ros_bridge.options import BridgeOptions
from ros_bridge.rig_topics import RigTopics
from rse_pf.errors import RsePfError
from rse_pf.geometry import Camera

__all__ = ["NO_MESSAGE", "IncomingFrames", "PairedImages", "Role", "kind_of"]

Role = Literal["colour", "depth", "right", "info", "right_info", "imu"]
NO_MESSAGE = "no message yet"
_FAULTS = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
_JUMP_NS = 1_000_000_000
"""A stamp that lies so far back is of a clock that was set, or of a bag that is played again."""
_NAMES = {"depth": "depth", "right": "right image"}
_WAITING = 30
"""So many images of a topic wait for their partner."""


def kind_of(role: Role, topic: str) -> str:
    """Return the type of a topic, as ROS 2 names it: by its role, and by the end of its name."""
    if role == "imu":
        return IMU
    if role in ("info", "right_info"):
        return CAMERA_INFO
    return COMPRESSED_IMAGE if topic.rstrip("/").endswith(("compressed", "compressedDepth")) else IMAGE


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


@dataclass(frozen=True, slots=True)
class PairedImages:
    """The messages of one frame: time stamp, frame of the camera, colours, and what belongs to them.

    That is ``partner``: depth, or the right image of a pair; None if there is none.
    """

    stamp_ns: int
    camera_frame: str
    colour: Any
    partner: Any


class IncomingFrames:
    """Pairs the images of two topics; any thread may `add`, another may `take` and `decode`.

    ``rig`` is what is known of a pair and of an IMU.
    """

    def __init__(self, maker: MessageMaker, options: BridgeOptions) -> None:
        self.left_out: Counter[str] = Counter()
        self.received: Counter[str] = Counter({"colour": 0, "depth": 0, "info": 0})
        self.rig = RigTopics(options)
        self.trouble = NO_MESSAGE
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
        self._camera: tuple[Camera, Rectifier] | None = None

    def add(self, role: Role, data: bytes | memoryview) -> bool:
        """Take the bytes of a message; return whether a frame became ready.  Nothing is raised."""
        with self._lock:
            self.received[role] += 1
            try:
                message = self._maker.decode(self._kinds[role], data)
                if role in ("info", "right_info"):
                    self._learn_camera(role, message)
                    return False
                if role == "imu":
                    waited = self._waits_for_imu()
                    self.rig.add_imu(message, _stamp_ns(message))
                    return waited and not self._waits_for_imu()
                self._check(role, message)
            except (BrokenMessage, RsePfError, *_FAULTS) as error:
                self.left_out["broken"] += 1
                self.trouble = f"a message of {getattr(self._options, role)} cannot be used: {error}"
                return False
            stamp_ns = _stamp_ns(message)
            if stamp_ns < self._last_ns - _JUMP_NS:
                self._begin_again(role, stamp_ns)
            elif self._is_straggler(role, stamp_ns):
                self.left_out["before the clock jumped back"] += 1
                return False
            elif stamp_ns <= self._last_ns:
                self.left_out["too late"] += 1
                return False
            bisect.insort(self._waiting[role], (stamp_ns, message), key=lambda each: each[0])
            if len(self._waiting[role]) > _WAITING:
                del self._waiting[role][0]
                self.left_out["without partner"] += 1
            before = len(self._ready)
            self._pair()
            return len(self._ready) > before

    def take(self) -> PairedImages | None:
        """Return the oldest frame that is ready, None if there is none, or if the IMU is behind it."""
        with self._lock:
            return self._ready.popleft() if self._ready and not self._waits_for_imu() else None

    def decode(self, images: PairedImages) -> Frame | None:
        """Return a frame without distortion; None, and a count, if its images make no sense."""
        camera = self._camera
        try:
            if camera is None:
                raise BrokenMessage(f"no camera_info came on {self._options.info}")
            wanted, rectifier = camera
            rgb = decode_colour(images.colour)
            if rgb.shape[:2] != (wanted.height, wanted.width):
                raise BrokenMessage(
                    f"images of {rgb.shape[1]}x{rgb.shape[0]} px do not fit the camera_info of "
                    f"{wanted.width}x{wanted.height} px"
                )
            with self._lock:
                samples = self.rig.imu_until(images.stamp_ns)
            made = Frame(
                timestamp_s=images.stamp_ns / 1e9, rgb=rgb, depth_m=no_depth(wanted), camera=wanted,
                imu=samples, T_body_camera=self.rig.T_body_camera,
            )  # fmt: skip
            if self._partner == "right":
                return self._pair_of(made, images.partner)
            if images.partner is not None:
                depth_m = decode_depth(images.partner, self._options.depth_scale)
                if depth_m.shape != rgb.shape[:2]:
                    raise BrokenMessage(f"depth on {self._options.depth} is not registered to the colours")
                made = replace(made, depth_m=rectifier.depth(depth_m))
            return replace(made, rgb=rectifier.colour(rgb))
        except (BrokenMessage, RsePfError, *_FAULTS) as error:
            with self._lock:
                self.left_out["broken"] += 1
                self.trouble = str(error)
            return None

    def _waits_for_imu(self) -> bool:
        """Return whether the only frame that is ready waits for the sample after it."""
        return len(self._ready) == 1 and self.rig.is_imu_due(self._ready[0].stamp_ns)

    def _pair_of(self, left: Frame, right: Any) -> Frame:
        """Return the rectified pair of a frame as it came, and the message of its right image."""
        rectification = self.rig.rectification
        if rectification is None:
            raise BrokenMessage(f"no camera_info came on {self._options.right_info}")
        gray = load_opencv().cvtColor(decode_colour(right), load_opencv().COLOR_RGB2GRAY)
        return replace(
            left, rgb=rectification.left(left.rgb), camera=rectification.camera,
            stereo=rectification.right(gray),
        )  # fmt: skip

    def _begin_again(self, role: Role, stamp_ns: int) -> None:
        """Forget what waits, and take stamps from before the last frame again.

        The other topic may lag behind: its next images, some at most, may still be from before the jump.
        """
        self._jump_ns = stamp_ns
        self._stragglers = Counter(dict.fromkeys(self._waiting, _WAITING))
        self._stragglers[role] = 0
        self.left_out["before the clock jumped back"] += sum(map(len, self._waiting.values()))
        for waiting in self._waiting.values():
            waiting.clear()
        self._last_ns = -1

    def _is_straggler(self, role: Role, stamp_ns: int) -> bool:
        """Return whether an image is from before the clock jumped back: it would hide its successors."""
        if not self._stragglers[role]:
            return False
        is_old = stamp_ns > self._jump_ns + _JUMP_NS // 2
        self._stragglers[role] = self._stragglers[role] - 1 if is_old else 0
        return is_old

    def _learn_camera(self, role: Role, message: Any) -> None:
        """Take the camera of the first good message; later ones of the same camera cost nothing."""
        self.rig.learn(role, message)
        if self._camera is None and role == "info":
            is_rectified = "rect" in self._options.colour.rsplit("/", 1)[-1]
            lens = lens_of(message, self._options.info, is_rectified=is_rectified)
            self._camera = (lens.camera, Rectifier(lens, lens.camera))

    def _check(self, role: Role, message: Any) -> None:
        """Refuse an image that is cut off, or unlike the first one of its topic."""
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
        """Make frames ready, in the order of time: a colour image with the partner nearest to it."""
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
                self.left_out["without partner"] += 1
                self.trouble = (
                    f"colours have no {_NAMES[self._partner]} within {self._options.pair_within_s:g} s"
                )
                continue
            self._make_ready(stamp_ns, colour, partners[nearest][1])
            self.left_out["without partner"] += nearest
            del partners[: nearest + 1]

    def _make_ready(self, stamp_ns: int, colour: Any, partner: Any) -> None:
        frame = self._options.camera_frame or str(colour.header.frame_id).lstrip("/") or "camera"
        self._ready.append(PairedImages(stamp_ns, frame, colour, partner))
        self._last_ns = stamp_ns
        if self.trouble.startswith(("no message", "colours have no")):
            self.trouble = ""
        if len(self._ready) > self._options.queue_frames:
            self._ready.popleft()
            self.left_out["too fast"] += 1

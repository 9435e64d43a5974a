"""A `pnp` command between its bytes and the bytes of its reply, without a Python object for each part of it.

The native core reads a command into numbers (`rse_pf.wire.native_codec`) and writes the reply to them
(`rse_pf.native_reply`).  Whoever needs more asks for the request, which is what the decoder in Python makes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

__all__ = ["EncodedReply", "PlainPnp"]


class PlainPnp(msgspec.Struct, frozen=True, gc=False):
    """The payload of a plain `pnp` command, as the native core has read it.

    ``numbers`` holds *points*, *pixels* and *depths* float64, one array behind the other; ``is_text`` says
    whether the command, and so its answer, is JSON.
    """

    numbers: bytes
    points: int
    pixels: int
    depths: int
    camera: Any
    options: Any
    is_text: bool
    make_request: Callable[..., Any]

    def request(self) -> Any:
        """Return the request of the service."""
        numbers = np.frombuffer(self.numbers, np.float64).copy()
        ends = self.points + self.pixels
        depths = {"depths_m": numbers[ends:]} if self.depths else {}
        return self.make_request(
            camera=self.camera, points_world=numbers[: self.points], pixels=numbers[self.points : ends],
            options=self.options, **depths,
        )  # fmt: skip


class EncodedReply:
    """A reply whose bytes the native core has written, and what a server tells of it."""

    __slots__ = ("_pose", "raw", "reason")

    def __init__(self, raw: msgspec.Raw, reason: str, pose: bytes) -> None:
        """Hold the encoded reply *raw*, why it is weak, and its ``(4, 4)`` float64 pose."""
        self.raw = raw
        self.reason = reason
        self._pose = pose

    @property
    def verdict(self) -> str:
        """``ok`` or ``weak``."""
        return "weak" if self.reason else "ok"

    @property
    def T_camera_world(self) -> npt.NDArray[np.float64]:
        """The ``(16,)`` numbers of the pose, row-major."""
        return np.frombuffer(self._pose, np.float64)

"""Ask a live map at which pose a keyframe was made, while the robot's segment is not aligned."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable

import numpy as np

from client_sdk.live.keyframe_queue import QueuedKeyframe
from client_sdk.live.keyframe_sender import LiveRobot
from client_sdk.live.options import LiveOptions
from rse_pf.errors import RsePfError
from rse_pf.geometry import Array, inverse
from rse_pf.slam.localise import PosePrior
from rse_pf.wire.live_map import LiveRelocalise, PriorPose, RelocaliseReply

__all__ = ["Relocaliser"]

_MAX_FAST_FAILURES = 6
"""Replies in a row that found no place in the map after which the robot asks less often: no other robot seems
to have been there, and the map server compares each keyframe that it receives with those of others anyway."""
_UPPER_TRIANGLE = np.triu_indices(6)  # the 21 numbers by which a message states a covariance
_SLOW_FACTOR = 4.0
"""The pause between relocalisations is this many times as long after `_MAX_FAST_FAILURES` such replies."""


class Relocaliser:
    """Ask a live map at which poses keyframes were made: one at a time, with a pause between two calls."""

    def __init__(
        self,
        robot: LiveRobot,
        map_name: str,
        options: LiveOptions,
        clock: Callable[[], float],
        on_reply: Callable[[int, Array, RelocaliseReply], None],
    ) -> None:
        """Store the arguments; `start_if_due` uses the network.

        Args:
            robot: The robot that calls ``live-relocalise``.
            map_name: Name of the live map.
            options: Pause between relocalisations, and their deadline.
            clock: Monotonic time in seconds.
            on_reply: Called with the keyframe's segment, its ``(4, 4)`` pose ``T_odom_camera``, and the map's
                reply; an RsePfError that it raises counts as a failed call.
        """
        self.trouble = ""
        """Why the last call failed, as ``code: sentence``; empty after a reply of any verdict."""
        self.verdicts: Counter[str] = Counter()
        """Number of replies for each verdict, and of failed calls for each error code."""
        self._robot, self._map_name, self._options = robot, map_name, options
        self._clock, self._on_reply = clock, on_reply
        self._started_s = float("-inf")
        self._failures_in_a_row = 0
        self._prior: PosePrior | None = None
        self._T_odom_then: Array | None = None
        self.task: asyncio.Task[None] | None = None
        """The task of the last call, which may have ended; None before the first."""

    @property
    def pause_s(self) -> float:
        """Time between the starts of two relocalisations, in seconds."""
        is_slow = self._failures_in_a_row >= _MAX_FAST_FAILURES
        return self._options.relocalise_s * (_SLOW_FACTOR if is_slow else 1.0)

    @property
    def has_prior(self) -> bool:
        """Whether a prior was given, and no keyframe has been localised since then."""
        return self._prior is not None

    def expect(self, prior: PosePrior, T_odom_camera: Array | None) -> None:
        """Send *prior* with each keyframe, moved with the odometry, until one is localised.

        Args:
            prior: Where the camera is in the map.
            T_odom_camera: ``(4, 4)`` pose of the camera then, in metres; None if the odometry has none or is
                without metric scale: the prior then is that of the keyframe, too.
        """
        self._prior, self._T_odom_then = prior, T_odom_camera
        self.skip_pause()

    def skip_pause(self) -> None:
        """Make the next keyframe due at once, and the pause after it short again."""
        self._started_s, self._failures_in_a_row = float("-inf"), 0

    def start_if_due(self, keyframe: QueuedKeyframe, T_odom_camera: Array) -> None:
        """Start a task that localises a keyframe, unless a task still runs or the pause is not over."""
        now = self._clock()
        is_running = self.task is not None and not self.task.done()
        if now >= self._started_s + self.pause_s and not is_running:
            self._started_s = now
            self.task = asyncio.create_task(self._localise(keyframe, T_odom_camera))

    async def _localise(self, keyframe: QueuedKeyframe, T_odom_camera: Array) -> None:
        prior = self._prior
        request = LiveRelocalise(
            map=self._map_name, keyframe=keyframe.data, prior=self._message_of(prior, T_odom_camera)
        )
        try:
            answer = await self._robot.call(
                "live-relocalise",
                request,
                RelocaliseReply,
                deadline_s=self._options.deadline_s,
                keep=True,
            )
            verdict = answer.reply.verdict
            self.trouble = ""
            self.verdicts[verdict] += 1
            self._failures_in_a_row = self._failures_in_a_row + 1 if verdict == "none" else 0
            if verdict == "ok" and self._prior is prior:
                self._prior = None
            self._on_reply(keyframe.segment, T_odom_camera, answer.reply)
        except RsePfError as error:
            self.verdicts[error.code] += 1
            self.trouble = f"{error.code}: {error.message}"

    def _message_of(self, prior: PosePrior | None, T_odom_camera: Array) -> PriorPose | None:
        """Return *prior* after the motion of the camera since then."""
        if prior is None:
            return None
        moved = np.eye(4) if self._T_odom_then is None else inverse(self._T_odom_then) @ T_odom_camera
        return PriorPose(
            T_map_camera=(prior.T_map_camera @ moved).ravel().tolist(),
            covariance=prior.covariance[_UPPER_TRIANGLE].tolist(),
        )

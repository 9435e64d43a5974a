"""A robot whose platform stores keyframes in a list, and publishes the updates that a test gives it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import msgspec
import numpy as np

from client_sdk.commands.answer_types import Answer, PoseAnswer
from client_sdk.frontend import PoseQuery
from rse_pf.errors import Conflict, Expired, NotFound, RsePfError
from rse_pf.geometry import Array
from rse_pf.pnp import PnpOptions, PnpSolution, refine_with_depth, solve_pnp
from rse_pf.wire import as_type
from rse_pf.wire.live_map import KeyframeRequest, LiveFloorPlan, LiveRelocalise, PriorPose

__all__ = ["FakeLiveRobot", "alignment", "solve", "solved"]


def alignment(
    robot: str, T_map_odom: Array | None, *, segment: int = 0, reason: str = "", scale: float | None = None
) -> dict[str, Any]:
    """Return the payload of an update ``alignment/ROBOT``; None for the pose means that it is not aligned."""
    return {
        **({} if scale is None else {"scale": scale}),
        "kind": "alignment", "robot": robot, "segment": segment, "aligned": T_map_odom is not None,
        "reason": reason, "T_map_odom": None if T_map_odom is None else T_map_odom.ravel().tolist(),
        "covariance": None if T_map_odom is None else (1e-4 * np.eye(6))[np.triu_indices(6)].tolist(),
        "version": 7, "cause": {"robot": "other", "number": 3},
    }  # fmt: skip


def solved(query: PoseQuery) -> PnpSolution:
    """Return the pose of a query as the PnP service solves it."""
    correspondences = query.correspondences
    options = PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations)
    solution = solve_pnp(correspondences.points_world, correspondences.pixels, query.camera, options)
    if correspondences.depths_m.any():
        solution = refine_with_depth(
            solution,
            correspondences.points_world,
            correspondences.pixels,
            correspondences.depths_m,
            query.camera,
        )
    return solution


async def solve(query: PoseQuery) -> PoseAnswer:
    """Answer a pose query as the PnP service does."""
    return PoseAnswer(
        solution=solved(query), source="cloud", server="s1", round_trip_ms=3.0, queue_ms=0.0, compute_ms=1.0
    )


class FakeLiveRobot:
    """The robot ``me`` and its platform; ``kept`` are the keyframes that its map has acknowledged."""

    def __init__(self) -> None:
        self.connected = True
        self.kept: list[KeyframeRequest] = []
        self.before_answer: Callable[[str], None] = lambda service: None
        """Called with the name of a service before the service answers; may raise the error of the call."""
        self.lose_answer = False
        self.asked: list[str] = []
        self.priors: list[PriorPose | None] = []
        """The prior of each request to relocalise."""
        self.relocalised: dict[str, Any] = {"verdict": "none", "reason": "nothing alike"}
        self.plans: list[dict[str, Any]] = []
        """The replies to requests for the floor plan, in their order; the last one is repeated."""
        self.known_plans: list[str] = []
        self.foreign_keyframes = 0
        self.has_images = False
        self.changed = asyncio.Event()
        self._updates: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()

    async def call(
        self, service: str, request: Any, reply_type: Any = None, *,
        deadline_s: float | None = None, keep: bool = False,
    ) -> Answer:  # fmt: skip
        """Answer a call as the platform would; raises RsePfError while the robot is not connected."""
        self.asked.append(service)
        await asyncio.sleep(0)
        try:
            if not self.connected:
                raise Expired("no server")
            self.before_answer(service)
            reply = getattr(self, "_" + service.partition("-")[2].replace("-", "_"))(request)
        finally:
            self.changed.set()
        if self.lose_answer:
            self.lose_answer = False
            raise Expired("the answer was lost")
        return Answer(
            reply=reply if reply_type is None else as_type(reply, reply_type),
            source="cloud", server="s1", round_trip_ms=1.0, queue_ms=0.0, compute_ms=0.0,
        )  # fmt: skip

    async def subscribe(self, topic: str) -> AsyncIterator[tuple[str, Any]]:
        """Yield the updates that `publish` was given."""
        assert topic == "live/lab"
        while True:
            yield await self._updates.get()

    def publish(self, key: str, payload: Any) -> None:
        """Publish an update of the map to the robot."""
        self._updates.put_nowait((key, payload))

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait until *condition* returns True, for 10 s at most; it is tested after each call."""

        async def wait() -> None:
            while not condition():
                self.changed.clear()
                try:
                    await asyncio.wait_for(self.changed.wait(), 0.02)
                except asyncio.TimeoutError:
                    continue

        await asyncio.wait_for(wait(), 10.0)

    def restart_map(self) -> None:
        """Start the map again, empty, as after ``live-stop``."""
        self.kept.clear()

    def _show(self, request: Any) -> Any:
        if not self.kept and not self.foreign_keyframes:
            raise NotFound("no such map")
        you = {
            "robot": "me",
            "number": len(self.kept),
            "segment": max((request.segment for request in self.kept), default=-1) + 1,
        }
        return {
            "keyframes": len(self.kept) + self.foreign_keyframes,
            "images": self.has_images,
            "you": you,
        }

    def _keyframe(self, request: Any) -> Any:
        keyframe = as_type(msgspec.to_builtins(request, builtin_types=(bytes,)), KeyframeRequest)
        if keyframe.number > len(self.kept):
            raise Conflict(f"keyframe {len(self.kept)} comes next")
        if keyframe.number == len(self.kept):
            self.kept.append(keyframe)
        return {"number": len(self.kept), "version": len(self.kept)}

    def _relocalise(self, request: Any) -> Any:
        asked = as_type(msgspec.to_builtins(request, builtin_types=(bytes,)), LiveRelocalise)
        self.priors.append(asked.prior)
        return self.relocalised

    def _floor_plan(self, request: LiveFloorPlan) -> Any:
        self.known_plans.append(request.known)
        return self.plans.pop(0) if len(self.plans) > 1 else self.plans[0]

    def _leave(self, request: Any) -> Any:
        return {}


def failing(error: RsePfError, service: str, times: int) -> Callable[[str], None]:
    """Return a function that raises *error* for the first *times* calls of *service*."""
    left = times

    def fail(called: str) -> None:
        nonlocal left
        if called == service and left > 0:
            left -= 1
            raise error

    return fail

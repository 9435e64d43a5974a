"""The solvers of pose queries for a comparison: the PnP service in this process, or a platform.

Both encode and decode commands as on the wire, so that poses and bytes are the same, and both measure their
cost.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Protocol

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import PoseQuery
from client_sdk.pose_answers import ask_robot
from client_sdk.robot import Robot
from rse_pf.config import PlatformSettings
from rse_pf.errors import error_from_code
from rse_pf.pnp import PnpOptions
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpReply, make_request
from rse_pf.services.pnp_reader import pnp_reader
from rse_pf.wire import Command, Failure, Result, as_type
from rse_pf.wire.server_codec import make_server_codec

__all__ = ["InProcessSolver", "MeteredSolver", "PlatformSolver", "platform_solver"]

# Codec of the commands.
_CODEC = "zlib"
# Name of the robot that asks for poses.
_ROBOT = "compare"


class MeteredSolver(Protocol):
    """A solver of pose queries that counts what its answers cost.

    ``sent_bytes`` are the bytes of all encoded commands, ``server_s`` the CPU seconds of the server's part,
    and ``inside_s`` that part of ``server_s`` which was spent in this process.
    """

    sent_bytes: int
    server_s: float
    inside_s: float

    async def ask(self, query: PoseQuery) -> PoseAnswer:
        """Return the pose that answers *query*; raises the RsePfError of a failure."""


class InProcessSolver:
    """Answers the pose queries of one run by the PnP service, in this process and deterministically.

    Every run needs a new solver: commands are numbered from 1, and a longer number would add to `sent_bytes`.
    """

    def __init__(self, settings: PlatformSettings) -> None:
        self.sent_bytes = 0
        self.server_s = 0.0
        self.inside_s = 0.0
        self._registry = builtin_services(settings)
        self._codec = make_server_codec(_CODEC, read_first=pnp_reader(self._registry, _CODEC))
        self._commands = 0

    async def ask(self, query: PoseQuery) -> PoseAnswer:
        """Encode *query* as the SDK does, decode and solve it as a server does, and return the pose."""
        self._commands += 1
        found = query.correspondences
        request = make_request(
            found.points_world, found.pixels, query.camera,
            PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations),
            depths_m=found.depths_m if found.depths_m.any() else None, depth_noise=query.depth_noise,
        )  # fmt: skip
        sent = self._codec.encode(Command(id=self._commands, service="pnp", payload=request))
        self.sent_bytes += len(sent)
        began_s = time.process_time()
        arrived = self._codec.decode_from_robot(sent)
        assert isinstance(arrived, Command)
        answered = self._codec.encode(dispatch(self._registry, arrived, time.monotonic, server=_ROBOT))
        took_s = time.process_time() - began_s
        self.server_s += took_s
        self.inside_s += took_s
        answer = self._codec.decode_from_server(answered)
        if isinstance(answer, Failure):
            raise error_from_code(answer.code, answer.message, hint=answer.hint)
        assert isinstance(answer, Result)
        reply: PnpReply = as_type(answer.reply, PnpReply)
        return PoseAnswer(
            solution=reply.solution(), source="robot", server="", round_trip_ms=1e3 * took_s,
            queue_ms=0.0, compute_ms=1e3 * took_s, payload_bytes=len(sent),
        )  # fmt: skip


class PlatformSolver:
    """Answers pose queries by the servers of a platform.

    ``server_s`` sums the compute times in their answers.
    """

    def __init__(self, robot: Robot) -> None:
        self.sent_bytes = 0
        self.server_s = 0.0
        self.inside_s = 0.0
        self._ask = ask_robot(robot.solve_pnp)

    async def ask(self, query: PoseQuery) -> PoseAnswer:
        """Return the pose with which a server answers *query*."""
        answer = await self._ask(query)
        self.sent_bytes += answer.payload_bytes
        self.server_s += answer.compute_ms / 1e3
        return answer


@asynccontextmanager
async def platform_solver(settings: PlatformSettings, folder: Path) -> AsyncIterator[PlatformSolver]:
    """Start a platform on this machine, connect a robot, and yield its solver; stop both after the block.

    *folder* is the state folder of the platform, from which the keys are deleted.
    """
    from client_sdk import connect
    from rse_pf.local.control.platform import LocalPlatform
    from rse_pf.local.state import remove_keys

    try:
        async with LocalPlatform(settings, port=0, state=folder, name="compare") as platform:

            async def fresh() -> str:
                return platform.issue_token(_ROBOT)

            async with connect(
                platform.url, token=fresh, codec=_CODEC, settings=settings.session
            ) as robot:  # fmt: skip
                yield PlatformSolver(robot)
    finally:
        remove_keys(folder)

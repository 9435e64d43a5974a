"""Answer commands on the robot itself, in one thread, with the `dispatch` that a server uses.

Only `LocalServices.prepare` imports the solvers, so that a robot that computes nothing itself starts quickly.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from rse_pf.errors import RsePfError
from rse_pf.service import Registry, dispatch, failure_of
from rse_pf.wire import Command, Failure, Result, make_codec

__all__ = ["LocalServices"]

RECENT_ANSWERS = 8
"""The robot expects that its next answer takes as long as the slowest of its last answers, of which this many
count."""


class LocalServices:
    """Hold the services that a robot computes itself, and answer one command at a time."""

    def __init__(self, registry: Registry | None, clock: Callable[[], float]) -> None:
        """Store the arguments; `prepare` loads the built-in services.

        Args:
            registry: The services; None means the built-in ones.
            clock: Monotonic seconds.
        """
        self._recent_s: deque[float] = deque(maxlen=RECENT_ANSWERS)
        self._registry = registry
        self._clock = clock
        self._codec = make_codec("bin")
        self._executor = ThreadPoolExecutor(1, "rse-pf-local-services")

    async def prepare(self) -> None:
        """Load the services, and measure how long the robot takes for a typical pose command.

        The command is computed twice, and only the second time counts, because the first includes imports.

        Raises:
            MissingExtra: No solver is installed.
        """
        await asyncio.get_running_loop().run_in_executor(self._executor, self._load_services)
        if self.offers("pnp"):
            command = _typical_pose_command()
            await self.ask(command)
            self._recent_s.clear()
            await self.ask(command)

    def offers(self, service: str) -> bool:
        """Return whether the robot can compute *service*; False for a built-in one before `prepare`."""
        return self._registry is not None and any(registered.name == service for registered in self._registry)

    async def ask(self, command: Command) -> Result | Failure:
        """Compute *command* on the robot, after all commands of earlier calls."""
        began_s = self._clock()
        loop = asyncio.get_running_loop()
        answer = await loop.run_in_executor(self._executor, self._answer, command)
        self._recent_s.append(self._clock() - began_s)
        return answer

    @property
    def solve_s(self) -> float | None:
        """The longest time in seconds from `ask` to its answer among the last eight; None before the first.

        It includes the time that a command waited for the commands before it.
        """
        return max(self._recent_s, default=None)

    def close(self) -> None:
        """End the thread after its present command, without waiting for it; cancel the commands that wait."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _answer(self, command: Command) -> Result | Failure:
        """Compute *command*; encode and decode it and its answer, so that both are as with a server."""
        assert self._registry is not None
        try:
            received = self._codec.decode_from_robot(self._codec.encode(command))
            assert isinstance(received, Command)
            answer = dispatch(self._registry, received, self._clock, server="robot")
            decoded = self._codec.decode_from_server(self._codec.encode(answer))
        except RsePfError as error:
            return failure_of(error, command, server="robot")
        assert isinstance(decoded, Result | Failure)
        return decoded

    def _load_services(self) -> None:
        from rse_pf.config import PlatformSettings
        from rse_pf.services.builtin import builtin_services

        if self._registry is None:
            self._registry = builtin_services(PlatformSettings())


def _typical_pose_command() -> Command:
    from rse_pf.pnp.problems import make_problem
    from rse_pf.services.pnp import make_request

    problem = make_problem(seed=0)
    request = make_request(problem.points_world, problem.pixels, problem.camera)
    return Command(id=0, service="pnp", payload=request)

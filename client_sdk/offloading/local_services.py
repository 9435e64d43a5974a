"""Services on the robot itself: the same `dispatch` as on a server, in one thread.

A solver is imported only by `LocalServices.prepare`.  Commands are answered one at a time.
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

_RECENT = 8


class LocalServices:
    """The services that a robot offers without the cloud."""

    def __init__(self, registry: Registry | None, clock: Callable[[], float]) -> None:
        self._recent_s: deque[float] = deque(maxlen=_RECENT)
        self._registry = registry
        self._clock = clock
        self._codec = make_codec("bin")
        self._executor = ThreadPoolExecutor(1, "rse-pf-local-services")

    async def prepare(self) -> None:
        """Load the services and measure a typical solve; a first one, which pays for imports, is not counted.

        Raises:
            MissingExtra: No solver is installed.
        """
        await asyncio.get_running_loop().run_in_executor(self._executor, self._prepare)
        if self.offers("pnp"):
            command = _typical_command()
            await self.ask(command)
            self._recent_s.clear()
            await self.ask(command)

    def offers(self, service: str) -> bool:
        """Return whether the robot offers *service*."""
        return self._registry is not None and any(registered.name == service for registered in self._registry)

    async def ask(self, command: Command) -> Result | Failure:
        """Answer *command* on the robot."""
        started = self._clock()
        loop = asyncio.get_running_loop()
        answer = await loop.run_in_executor(self._executor, self._answer, command)
        self._recent_s.append(self._clock() - started)
        return answer

    @property
    def solve_s(self) -> float | None:
        """The longest of the last few answers, in seconds, or None before the first."""
        return max(self._recent_s, default=None)

    def close(self) -> None:
        """End the thread; the answer that it works on is dropped."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _answer(self, command: Command) -> Result | Failure:
        """Dispatch the command encoded and decoded, exactly as a server receives it."""
        assert self._registry is not None
        try:
            arrived = self._codec.decode_from_robot(self._codec.encode(command))
            assert isinstance(arrived, Command)
            answer = dispatch(self._registry, arrived, self._clock, server="robot")
            sent = self._codec.decode_from_server(self._codec.encode(answer))
        except RsePfError as error:
            return failure_of(error, command, server="robot")
        assert isinstance(sent, Result | Failure)
        return sent

    def _prepare(self) -> None:
        from rse_pf.config import PlatformSettings
        from rse_pf.services.builtin import builtin_services

        if self._registry is None:
            self._registry = builtin_services(PlatformSettings())


def _typical_command() -> Command:
    from rse_pf.pnp.problems import make_problem
    from rse_pf.services.pnp import make_request

    problem = make_problem(seed=0)
    request = make_request(problem.points_world, problem.pixels, problem.camera)
    return Command(id=0, service="pnp", payload=request)

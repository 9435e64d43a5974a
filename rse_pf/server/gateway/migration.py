"""Ask some robots of a loaded server to connect to another server, spread over time.

In the supervisor, `plan` decides when each worker asks its next robot; in the worker, `Migration` chooses the
robots at random and asks them.  At most ``moves_per_s`` robots are asked in a second, and a robot that was
asked is not asked again before its time to move is over.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from rse_pf.server.gateway.connection import RobotConnection

__all__ = ["Migration", "plan"]


def plan(
    loads: Sequence[int], robots: int, *, spread_s: float, moves_per_s: float, random: Callable[[], float]
) -> list[list[float]]:
    """Return a list for each worker: the ascending delays, in seconds, after each of which it asks one robot.

    1. The duration is divided into equal time slots, one for each robot.
    2. In each slot, the worker that has most robots left asks one of them.
    3. It does so at a random time within the slot, so that neither robots nor servers act at the same time.

    Args:
        loads: Number of robots of each worker.
        robots: Number of robots to be asked; all are asked if there are fewer.
        spread_s: Duration of the migration in seconds; longer if *moves_per_s* requires it.
        moves_per_s: Greatest number of robots that are asked in a second.
        random: Returns uniform random numbers in ``[0, 1)``.
    """
    remaining = list(loads)
    delays: list[list[float]] = [[] for _ in loads]
    count = min(robots, sum(remaining))
    slot_s = max(spread_s / count, 1 / moves_per_s) if count else 0.0
    for slot in range(count):
        worker = max(range(len(remaining)), key=remaining.__getitem__)
        remaining[worker] -= 1
        delays[worker].append((slot + random()) * slot_s)
    return delays


class Migration:
    """Asks robots of one worker to move; ``asked`` counts them since the start."""

    def __init__(
        self,
        connections: Iterable[RobotConnection],
        *,
        loop: AbstractEventLoop,
        now: Callable[[], float],
        choose: Callable[[Sequence[RobotConnection]], RobotConnection],
    ) -> None:
        """Ask no robot yet.

        Args:
            connections: The connections of this worker; the dispatcher adds and removes them.
            loop: The event loop of the worker.
            now: Returns monotonic seconds.
            choose: Returns one of several connections, at random.
        """
        self.asked = 0
        self._connections = connections
        self._loop = loop
        self._now = now
        self._choose = choose

    def begin(self, delays_s: Iterable[float], within_ms: float) -> None:
        """Ask one robot after each of the delays, in seconds; the robot has *within_ms* to move."""
        for delay_s in delays_s:
            self._loop.call_later(delay_s, partial(self._ask, within_ms))

    def _ask(self, within_ms: float) -> None:
        """Ask one random robot that sent its Hello and was not asked to move recently, if there is one."""
        now = self._now()
        candidates = [
            connection
            for connection in self._connections
            if connection.may_move and connection.moving_until_s <= now
        ]
        if candidates:
            self.asked += 1
            self._choose(candidates).move("rebalance", within_ms, now)

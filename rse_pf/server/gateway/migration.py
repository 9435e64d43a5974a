"""Ask some robots of a loaded server to move to another server, spread over time.

`plan` decides in the supervisor when each worker asks its next robot; `Migration` asks them in the worker.
At most ``moves_per_s`` robots are asked in a second, and no robot is asked again while it has time to move.
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
    """Return for each worker the delays in seconds after which it asks one robot each, in order.

    The most loaded worker asks next.  Each request to move comes at a random time within a time slot of its
    own, so that neither robots nor servers act at the same time.

    Args:
        loads: Robots of each worker.
        robots: How many robots are asked; at most all are.
        spread_s: Duration of the migration in seconds; longer if *moves_per_s* requires it.
        moves_per_s: Greatest number of robots asked in a second.
        random: Uniform numbers in ``[0, 1)``.
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
    """The requests to move of one worker."""

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
            connections: The live connections of this worker; others add and remove them.
            loop: Event loop of the worker.
            now: The worker's monotonic clock, s.
            choose: Picks one of several connections, at random.
        """
        self.asked = 0
        self._connections = connections
        self._loop = loop
        self._now = now
        self._choose = choose

    def begin(self, delays_s: Iterable[float], within_ms: float) -> None:
        """Ask one robot after each of *delays_s*; each gets *within_ms* to leave."""
        for delay_s in delays_s:
            self._loop.call_later(delay_s, partial(self._ask, within_ms))

    def _ask(self, within_ms: float) -> None:
        now = self._now()
        candidates = [
            connection
            for connection in self._connections
            if connection.may_move and connection.moving_until_s <= now
        ]
        if candidates:
            self.asked += 1
            self._choose(candidates).move("rebalance", within_ms, now)

"""Ask some of a crowded server's robots to move to another server, spread over time.

`plan` says when each worker asks its next robot; `Migration` does it in a worker.  Promises never more asks
in a second than the settings allow, no robot asked twice while its first ask is still good, and to read
neither a clock nor a source of randomness that it was not given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from rse_pf.backend.gateway.connection import RobotConnection

__all__ = ["Migration", "plan"]


class Timers(Protocol):
    """What `Migration` needs of an event loop."""

    def call_later(self, delay: float, callback: Callable[..., object], *args: object) -> object:
        """Call *callback* in *delay* seconds."""


def plan(
    loads: Sequence[int], robots: int, *, spread_s: float, moves_per_s: float, random: Callable[[], float]
) -> list[list[float]]:
    """Return for each worker after how many seconds it asks one robot each, in order.

    The most loaded worker asks next.  Each ask has a time slot of its own and comes at a random time within
    it, so that neither robots nor servers keep step.

    Args:
        loads: Robots of each worker.
        robots: How many shall move; at most all are asked.
        spread_s: Time the whole hand-over takes, longer if *moves_per_s* demands it.
        moves_per_s: Slots in a second, at most.
        random: Uniform numbers in ``[0, 1)``.
    """
    left = list(loads)
    delays: list[list[float]] = [[] for _ in loads]
    count = min(robots, sum(left))
    slot_s = max(spread_s / count, 1 / moves_per_s) if count else 0.0
    for slot in range(count):
        worker = max(range(len(left)), key=left.__getitem__)
        left[worker] -= 1
        delays[worker].append((slot + random()) * slot_s)
    return delays


class Migration:
    """The asks of one worker."""

    def __init__(
        self,
        connections: Iterable[RobotConnection],
        *,
        timers: Timers,
        now: Callable[[], float],
        choose: Callable[[Sequence[RobotConnection]], RobotConnection],
    ) -> None:
        """Keep what is needed.

        Args:
            connections: The live ones of this worker, now and later.
            timers: The event loop.
            now: The worker's monotonic clock, s.
            choose: Picks one, at random.
        """
        self.asked = 0
        self._connections = connections
        self._timers = timers
        self._now = now
        self._choose = choose
        self._good_until: dict[RobotConnection, float] = {}

    def begin(self, delays_s: Iterable[float], within_ms: float) -> None:
        """Ask one robot after each of *delays_s*; each gets *within_ms* to leave."""
        for delay_s in delays_s:
            self._timers.call_later(delay_s, self._ask_one, within_ms)

    def _ask_one(self, within_ms: float) -> None:
        now = self._now()
        present = list(self._connections)
        self._good_until = {each: self._good_until.get(each, 0.0) for each in present}
        candidates = [each for each in present if each.may_move and self._good_until[each] <= now]
        if not candidates:
            return
        chosen = self._choose(candidates)
        self._good_until[chosen] = now + within_ms / 1e3
        self.asked += 1
        chosen.move("rebalance", within_ms, now)

"""Whose job comes next, and whose must make room: robots take turns, however many jobs one of them asks for.

Pure.  Promises that a robot which asks for one job waits for at most one job of each other robot that came
before it, and that nobody waits for ever because others keep coming.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

__all__ = ["FairQueue", "Who", "who_makes_room"]

Who = tuple[str, str]
"""Tenant and robot."""


class FairQueue:
    """Those who wait for a turn: robots in a ring, and each robot's tickets in the order of asking."""

    def __init__(self) -> None:
        self._tickets: dict[Who, list[object]] = {}

    def join(self, ticket: object, who: Who) -> None:
        """Let *who* wait under *ticket*; a robot that did not wait comes last."""
        self._tickets.setdefault(who, []).append(ticket)

    def first(self) -> object | None:
        """Return the ticket whose turn is next."""
        return next(iter(self._tickets.values()))[0] if self._tickets else None

    def served(self, ticket: object) -> None:
        """Note that *ticket* got its turn: its robot goes behind all others."""
        who = self.leave(ticket)
        if who in self._tickets:
            self._tickets[who] = self._tickets.pop(who)

    def leave(self, ticket: object) -> Who | None:
        """Forget *ticket*, if it waits, and return whose it was; it costs its robot nothing."""
        for who, tickets in self._tickets.items():
            if ticket in tickets:
                tickets.remove(ticket)
                if not tickets:
                    del self._tickets[who]
                return who
        return None


def who_makes_room(jobs: Sequence[tuple[Who, bool]], newcomer: Who) -> int | None:
    """Return which of *jobs* must make room for one more of *newcomer*; None if it has to come again.

    It is the newest that waits of the robot with the most jobs, if that has at least two more than the
    newcomer: with one, it would only change who is the last.

    Args:
        jobs: Each job's robot and whether it still waits, in the order of asking.
        newcomer: Who asks.
    """
    count = Counter(who for who, _ in jobs)
    rows = [row for row, (who, waits) in enumerate(jobs) if waits and count[who] > count[newcomer] + 1]
    return max(rows, key=lambda row: (count[jobs[row][0]], row), default=None)

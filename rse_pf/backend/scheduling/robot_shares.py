"""How many commands a second each robot may send, so that all of them together offer what can be served.

Counts and times go in, a rate comes out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rse_pf.identity import RobotId

__all__ = ["AGAIN_S", "TOLD_S", "RobotShares"]

TOLD_S, AGAIN_S = 1.4, 0.4
"""A robot keeps to the rate that it was told for so long.  It is told again with the command that finds so
much left of it, or with the first one after it; else most would be free between two refusals."""
_LEAST_PER_S = 1.2
"""Robots that were told less would be free before their next command, and all at the same time."""
_WINDOW_S = 1.0
"""Robots and commands are counted for so long; a robot that sends more rarely needs no share."""
_MORE, _REFUSED_COUNTS, _LESS = 1.25, 2.5, 0.85
"""In each window shares change by the first number, less the refused part of what was asked for times the
second, and at least by the third: they grow until a tenth is refused.  What robots are told is seen a second
later in what they send."""
_REMEMBERED = 0.95
"""What can be served is the most of all windows; it counts less by this factor after each in which commands
were refused.  One window alone says little: what robots that were told too little send is served, and is too
little.  What a free robot sends is the most of all windows, too, and is lowered by each without overload."""
_EASY, _FEW_REFUSED, _ROOM, _ENOUGH_COUNTS = 0.85, 0.02, 6, 3
"""A server that serves less than the first part of what it can has clearly less to do.  It has room after so
many such intervals in a row in which at most the second part was refused.  An interval counts as the fourth
number of them where free robots would send no more than can be served."""
_GOLDEN = 0.6180339887
_LEAST, _MOST = 0.5, 4.0
"""Bounds of the product of these factors: robots that send less than their share leave room for others."""


@dataclass
class RobotShares:
    """The equal share of each robot in what a server serves.

    Attributes:
        per_s: Commands a second of each robot; 0 while it is not known.
        connected: How many robots are connected.
        is_easy: Whether clearly less was asked for in the last interval than can be served.
        is_enough: Whether what can be served, or the share, is as much as free robots send.
        has_room: Whether that is so for longer, and nearly nothing was refused: robots are told that they are
            free.
    """

    per_s: float = 0.0
    connected: int = 0
    is_easy: bool = True
    is_enough: bool = True
    has_room: bool = False
    _sent: set[RobotId] = field(default_factory=set)
    _sent_before: set[RobotId] = field(default_factory=set)
    _received: int = 0
    _free_per_s: float = 0.0
    _since_s: float = -math.inf
    _judged_s: float = -math.inf
    _room_count: int = 0
    _is_first: bool = False
    _started: int = 0
    _refused: int = 0
    _capacity_per_s: float = 0.0
    _factor: float = 1.0
    _phase: float = 0.0

    def next_spread(self) -> float:
        """Return a factor from 0.5 to 1.5 for what one robot is told: robots told together return apart.

        With 0.75 to 1.25, at three times the capacity, all of them would still return about once a second.

        Source:
            Additive recurrence by the golden ratio; any few of them in a row are spread evenly.
        """
        self._phase = (self._phase + _GOLDEN) % 1.0
        return 0.5 + self._phase

    def note(self, robot: RobotId) -> None:
        """Count a command of *robot*, whether it is served or not."""
        self._received += 1
        self._sent.add(robot)

    def forget(self, robot: RobotId) -> None:
        """Leave its share to the others: *robot* disconnected."""
        self._sent.discard(robot)
        self._sent_before.discard(robot)

    def begin(self, now: float) -> None:
        """Count from *now* (s): the server fell behind."""
        self._judged_s, self._room_count, self.has_room, self._is_first = now, 0, False, True
        self._sent |= self._sent_before
        self._begin_window(now)
        self._share()

    def note_free(self, now: float, served_per_s: float) -> None:
        """Note how much was served until *now* (s) while the server was not behind."""
        self._capacity_per_s = max(served_per_s, self._capacity_per_s)
        if now - self._since_s >= _WINDOW_S:
            self._free_per_s *= _REMEMBERED
            self._end_window(now)

    def judge(self, now: float, started: int, refused: int) -> None:
        """Note what an interval that ends at *now* (s) brought.

        Args:
            now: Its end.
            started: Commands that were served.
            refused: Commands that were not, apart from those of robots that did not wait as they were told.
        """
        self._started += started
        self._refused += refused
        can_be_served = self._capacity_per_s * (now - self._judged_s)
        self._judged_s = now
        self.is_easy = not started or started < _EASY * can_be_served
        elapsed_s = now - self._since_s
        if elapsed_s >= _WINDOW_S:
            asked = self._started + self._refused
            refused_part = self._refused / asked if asked else 0.0
            remembered = _REMEMBERED if refused_part > _FEW_REFUSED else 1.0
            self._capacity_per_s = max(self._started / elapsed_s, remembered * self._capacity_per_s)
            if asked and not self._is_first:
                change = max(_LESS, _MORE - _REFUSED_COUNTS * refused_part)
                self._factor = min(_MOST, max(_LEAST, change * self._factor))
            self._end_window(now)
        self._share()
        there_is_room = refused <= _FEW_REFUSED * (started + refused) and (self.is_enough or self.is_easy)
        counts = _ENOUGH_COUNTS if self.is_enough else 1
        self._room_count = self._room_count + counts if there_is_room else 0
        self.has_room = self._room_count >= _ROOM

    def _share(self) -> None:
        """Divide what can be served; all that are connected count while too few were heard of."""
        robots = max(len(self._sent), len(self._sent_before), self.connected if self._is_first else 0)
        if robots and self._capacity_per_s:
            equal_per_s = self._capacity_per_s / robots
            self.per_s = max(_LEAST_PER_S, self._factor * equal_per_s)
            self.is_enough = max(equal_per_s, self.per_s) >= self._free_per_s

    def _end_window(self, now: float) -> None:
        if self._sent:
            sent_per_s = self._received / (now - self._since_s) / len(self._sent)
            self._free_per_s = max(self._free_per_s, sent_per_s)
        self._is_first = False
        self._begin_window(now)

    def _begin_window(self, now: float) -> None:
        self._sent_before, self._sent = self._sent, set()
        self._since_s, self._received, self._started, self._refused = now, 0, 0, 0

"""How many commands a second each robot may send, so that all of them together offer what can be served.

Counts and times go in, a rate comes out; the scheduler feeds it while the server is behind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rse_pf.identity import RobotId

__all__ = ["AGAIN_S", "TOLD_S", "RobotShares"]

TOLD_S, AGAIN_S = 1.0, 0.4
"""A robot keeps to the rate that it was told for so long, and is told again when so much is left: all are
free a second after the server is no longer behind, and none returns for a moment before."""
_LEAST_PER_S = 1.2 / TOLD_S
"""Robots that were told less would be free before their next command, and all at the same time."""
_WINDOW_S = 1.0
"""Robots and commands are counted for so long; a robot that sends more rarely needs no share."""
_WANTED, _LESS, _MORE = 1.1, 0.85, 1.3
"""Robots should ask for `_WANTED` times what is served; their share changes by the other factors at most, and
once in a window only: what robots are told is seen a second later in what they send."""
_REMEMBERED = 0.95
"""What can be served is the most of all windows; while the server is behind, each counts less by this factor.
One window alone says little: what robots that were told too little send is served, and is too little."""
_ROOM, _FEW_REFUSED, _ROOM_INTERVALS = 0.85, 0.02, 2
"""There is room after so many intervals in a row in which less than the first share of what can be served was
asked for, and at most the second share of it was refused."""
_GOLDEN = 0.6180339887
_LEAST, _MOST = 0.5, 4.0
"""Bounds of the product of these factors: robots that send less than their share leave room for others."""


@dataclass
class RobotShares:
    """The equal share of each robot in what a server serves.

    Attributes:
        per_s: Commands a second of each robot; 0 while it is not known.
        is_easy: Whether clearly less was asked for in the last interval than can be served.
        has_room: Whether that is so for longer, and nearly nothing was refused: robots are told that they are
            free.
        sent: The robots that sent a command since the last window ended.
    """

    per_s: float = 0.0
    is_easy: bool = True
    has_room: bool = False
    sent: set[RobotId] = field(default_factory=set)
    _since_s: float = -math.inf
    _judged_s: float = -math.inf
    _room_count: int = 0
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

    def begin(self, now: float) -> None:
        """Count from *now* (s): the server fell behind."""
        self._judged_s, self._room_count, self.has_room = now, 0, False
        self._begin_window(now)

    def note_free(self, served_per_s: float) -> None:
        """Note how much was served while the server was not behind."""
        self._capacity_per_s = max(served_per_s, self._capacity_per_s)

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
        self.is_easy = not started or started < _ROOM * can_be_served
        there_is_room = self.is_easy and refused <= _FEW_REFUSED * (started + refused)
        self._room_count = self._room_count + 1 if there_is_room else 0
        self.has_room = self._room_count >= _ROOM_INTERVALS
        elapsed_s = now - self._since_s
        if elapsed_s >= _WINDOW_S:
            asked = self._started + self._refused
            self._capacity_per_s = max(self._started / elapsed_s, _REMEMBERED * self._capacity_per_s)
            if self.per_s and asked:
                change = min(_MORE, max(_LESS, _WANTED * self._started / asked))
                self._factor = min(_MOST, max(_LEAST, change * self._factor))
            if self.sent:
                self.per_s = max(_LEAST_PER_S, self._factor * self._capacity_per_s / len(self.sent))
            self._begin_window(now)

    def _begin_window(self, now: float) -> None:
        self.sent.clear()
        self._since_s, self._started, self._refused = now, 0, 0

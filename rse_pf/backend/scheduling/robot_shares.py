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
_WINDOW_S = 1.0
"""Robots and commands are counted for so long; a robot that sends more rarely needs no share."""
_LESS, _MORE = 0.9, 1.03
"""Factors of the share in each interval in which many, or hardly any, commands were refused."""
_GOLDEN = 0.6180339887
_LEAST, _MOST = 0.2, 4.0
"""Bounds of the product of these factors: robots that send less than their share leave room for others."""


@dataclass
class RobotShares:
    """The equal share of each robot in what a server serves.

    Attributes:
        per_s: Commands a second of each robot; 0 while it is not known.
        sent: The robots that sent a command since the last window ended.
    """

    per_s: float = 0.0
    sent: set[RobotId] = field(default_factory=set)
    _since_s: float = -math.inf
    _started: int = 0
    _capacity_per_s: float = 0.0
    _was_full: bool = False
    _factor: float = 1.0
    _phase: float = 0.0

    def next_spread(self) -> float:
        """Return a factor from 0.75 to 1.25 for what one robot is told: robots told together return apart.

        Source:
            Additive recurrence by the golden ratio; any few of them in a row are spread evenly.
        """
        self._phase = (self._phase + _GOLDEN) % 1.0
        return 0.75 + 0.5 * self._phase

    def begin(self, now: float) -> None:
        """Count from *now* (s): the server fell behind."""
        self.sent.clear()
        self._since_s, self._started, self._was_full = now, 0, False

    def judge(self, now: float, started: int, *, less: bool, more: bool) -> None:
        """Note what an interval that ends at *now* (s) brought.

        Args:
            now: Its end.
            started: Commands that were served.
            less: Whether so many were refused that robots should send less.
            more: Whether hardly any was refused.
        """
        self._started += started
        if less:
            self._was_full = True
            self._factor = max(_LEAST, _LESS * self._factor)
        elif more:
            self._factor = min(_MOST, _MORE * self._factor)
        elapsed_s = now - self._since_s
        if elapsed_s >= _WINDOW_S:
            served_per_s = self._started / elapsed_s
            # What is served while hardly anything is refused may be all that was asked for.
            full = self._was_full or served_per_s > self._capacity_per_s
            self._capacity_per_s = served_per_s if full else self._capacity_per_s
            if self.sent:
                self.per_s = self._factor * self._capacity_per_s / len(self.sent)
            self.begin(now)

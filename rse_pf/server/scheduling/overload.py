"""Decide which commands a server refuses because it has more to do than it can, and for how long.

A command that is expected to wait for less than 20 % of the time until its deadline is accepted.  From there
the refused share grows in proportion, so that the queue settles, where a fixed threshold would swing; at 50
% or, if that is later, 1.5 s before the deadline, all are refused.  What is accepted and then waits for too
long is given up.  Where there are several tenants, no command is refused of one of which fewer commands were
accepted in the last second or two than of the average tenant.

A refused robot pauses.  A pause spans several frames, so that most of what arrives is accepted as long as
robots obey: a refusal costs about half of what a small answer costs.  A robot that goes on sending is served
one command at a time, and the network holds back the rest.

Pure: times go in, decisions come out, and nothing is random.

Source:
    Random early detection, Floyd and Jacobson 1993.
"""

from __future__ import annotations

import math

__all__ = ["MAX_EARLY_COMMANDS", "PAUSE_S", "Overload", "TurnTime", "is_too_late"]

MIN_WAIT_SHARE = 0.2  # of the time of a command: a shorter wait is no overload
MAX_WAIT_SHARE = 0.5  # of the time of a command: the other half is for compute and network
MAX_QUEUED_SHARE = 0.75  # of the time of a command: one that waited for longer would be answered too late
RESERVE_S = 1.5  # for compute and network: a command with more than 3 s may wait for all but this
PAUSE_S = 1.0  # mean pause of a refused robot: it spans five frames of a camera at 5 Hz
MAX_EARLY_COMMANDS = 8  # within one pause: as many as were on their way when the robot was refused
MEMORY_S = 1.0  # time after which what was accepted of a tenant counts half: some frames of each robot
SMOOTHING = 0.01  # weight of the last turn: the time that some refusals take must not cause others
GOLDEN_RATIO = 0.6180339887  # additive recurrence by it: any few numbers in a row are spread evenly


class Overload:
    """The rule of one queue."""

    def __init__(self) -> None:
        self._spread = 0.0
        self._accepted: dict[str, int] = {}  # by tenant; halved every `MEMORY_S`
        self._accepted_in_all = 0
        self._halved_s = -math.inf

    def pause_s(self, tenant: str, expected_wait_s: float, allowed_s: float) -> float:
        """Return for how long a robot of *tenant* pauses whose command is refused; 0 accepts the command.

        Asked again about an accepted command, before anything else is decided, the answer is the same, so
        that the rule may be asked before and after decoding.  Pauses differ by up to half of `PAUSE_S`, so
        that robots that are refused together do not return together.

        Args:
            tenant: Of the robot.
            expected_wait_s: How long the command would wait for its turn.
            allowed_s: Time from its arrival to its deadline.
        """
        min_wait_s = MIN_WAIT_SHARE * allowed_s
        if expected_wait_s <= min_wait_s or allowed_s <= 0.0 or self._is_below_fair_part(tenant):
            return 0.0  # a command without any time left is not refused here; it expires
        max_wait_s = max(MAX_WAIT_SHARE * allowed_s, allowed_s - RESERVE_S)
        excess = (expected_wait_s - min_wait_s) / (max_wait_s - min_wait_s)
        refused_share = min(1.0, excess)
        spread = self._spread / refused_share
        if spread >= 1.0:
            return 0.0
        self._advance()
        return PAUSE_S * (0.5 + spread)

    def note_accepted(self, tenant: str, now: float) -> None:
        """Count a command of *tenant* that was accepted at *now* (s)."""
        if now - self._halved_s >= MEMORY_S:
            self._halved_s = now
            self._accepted = {name: count // 2 for name, count in self._accepted.items() if count > 1}
            self._accepted_in_all = sum(self._accepted.values())
        self._accepted[tenant] = self._accepted.get(tenant, 0) + 1
        self._accepted_in_all += 1
        self._advance()

    def _is_below_fair_part(self, tenant: str) -> bool:
        own = self._accepted.get(tenant, 0)
        return (own + 1) * len(self._accepted) < self._accepted_in_all

    def _advance(self) -> None:
        self._spread = (self._spread + GOLDEN_RATIO) % 1.0


class TurnTime:
    """The mean time that a command waits for each position in the queue; those that are given up count."""

    def __init__(self) -> None:
        self.mean_s = 0.0

    def note(self, waited_s: float, position: int) -> None:
        """Count a command that left the queue after *waited_s*, and had entered it at *position*, from 1."""
        self.mean_s += SMOOTHING * (waited_s / position - self.mean_s)


def is_too_late(waited_s: float, allowed_s: float) -> bool:
    """Return whether a command that waited for *waited_s* of *allowed_s* is given up."""
    return waited_s > max(MAX_QUEUED_SHARE * allowed_s, allowed_s - RESERVE_S)

"""Decide which commands a server refuses because it is overloaded, and how long a refused robot pauses.

The rule is random early detection (RED) with the expected wait in place of the mean queue length:

1. The expected wait is the number of commands ahead in the queue, times the mean wait for each position.
2. Below `MIN_WAIT_SHARE` of the time until its deadline, a command is accepted.
3. From there the refused share grows linearly to 1 at the maximum wait, so that the length of the queue
   settles; with a fixed threshold it would oscillate.  The maximum is `MAX_WAIT_SHARE` of the time until the
   deadline or, if that is later, `RESERVE_S` before the deadline.
4. A command of a tenant of which fewer commands than of the average tenant were accepted lately is never
   refused, so a tenant that floods the server takes no answers of others.
5. An accepted command that then waits for too long (`is_too_late`) is refused after all.

A refused robot pauses for several frames, because a refusal costs about half of what a small answer costs.  A
robot that sends during its pause is read one command at a time (`MAX_EARLY_COMMANDS`), so that TCP holds the
rest back.

Pure: times go in, decisions come out.  Instead of random numbers, an additive recurrence (Weyl sequence)
spreads refusals and pauses evenly.

Source:
    Floyd and Jacobson, Random Early Detection Gateways for Congestion Avoidance, 1993.
"""

from __future__ import annotations

import math

__all__ = ["MAX_EARLY_COMMANDS", "PAUSE_S", "OverloadControl", "WaitPerPosition", "is_too_late"]

MIN_WAIT_SHARE = 0.2  # of the time until the deadline; a shorter wait is no overload
MAX_WAIT_SHARE = 0.5  # of the time until the deadline; the other half is for computation and network
MAX_QUEUED_SHARE = 0.75  # of the time until the deadline; an answer after a longer wait would come too late
RESERVE_S = 1.5  # for computation and network: a command with more than 3 s may wait for all but this
PAUSE_S = 1.0  # mean pause of a refused robot: five frames of a camera at 5 Hz
MAX_EARLY_COMMANDS = 8  # in one pause: as many as may have been on their way when the robot was refused
HALVING_S = 1.0  # counts of accepted commands are halved this often: some frames of each robot are counted
WAIT_SMOOTHING = 0.01  # weight of the last wait in the mean: one burst of refusals must not cause others
GOLDEN_RATIO = 0.6180339887  # step of the additive recurrence: any few consecutive numbers are spread evenly


class OverloadControl:
    """The state of the rule for one queue."""

    def __init__(self) -> None:
        self._spread = 0.0  # the present number of the recurrence, in [0, 1)
        self._accepted: dict[str, int] = {}  # commands by tenant, halved every `HALVING_S`
        self._accepted_of_all = 0
        self._halved_s = -math.inf

    def pause_s(self, tenant: str, expected_wait_s: float, allowed_s: float) -> float:
        """Return how long a robot of *tenant* pauses because its command is refused; 0 accepts the command.

        The answer about an accepted command stays the same until something else is decided, so that the rule
        may be asked before and after decoding.  Pauses are spread from half to one and a half `PAUSE_S`, so
        that robots which are refused together do not return together.

        Args:
            tenant: The tenant of the robot.
            expected_wait_s: How long the command would wait, in seconds.
            allowed_s: Seconds from its arrival to its deadline.
        """
        min_wait_s = MIN_WAIT_SHARE * allowed_s
        if expected_wait_s <= min_wait_s or allowed_s <= 0.0 or self._is_below_average(tenant):
            return 0.0  # a command that has no time left is not refused here: it expires
        max_wait_s = max(MAX_WAIT_SHARE * allowed_s, allowed_s - RESERVE_S)
        refused_share = min(1.0, (expected_wait_s - min_wait_s) / (max_wait_s - min_wait_s))
        spread = self._spread / refused_share
        if spread >= 1.0:
            return 0.0
        self._advance()
        return PAUSE_S * (0.5 + spread)

    def note_accepted(self, tenant: str, now: float) -> None:
        """Count a command of *tenant* that was accepted at *now* (s)."""
        if now - self._halved_s >= HALVING_S:
            self._halved_s = now
            self._accepted = {name: count // 2 for name, count in self._accepted.items() if count > 1}
            self._accepted_of_all = sum(self._accepted.values())
        self._accepted[tenant] = self._accepted.get(tenant, 0) + 1
        self._accepted_of_all += 1
        self._advance()

    def _is_below_average(self, tenant: str) -> bool:
        own = self._accepted.get(tenant, 0)
        return (own + 1) * len(self._accepted) < self._accepted_of_all

    def _advance(self) -> None:
        self._spread = (self._spread + GOLDEN_RATIO) % 1.0


class WaitPerPosition:
    """The exponential moving average of the wait for each position in the queue, in seconds."""

    def __init__(self) -> None:
        self.mean_s = 0.0

    def note(self, waited_s: float, position: int) -> None:
        """Count a command that left the queue after *waited_s*, started or refused.

        *position* is the one at which it was queued, from 1.
        """
        self.mean_s += WAIT_SMOOTHING * (waited_s / position - self.mean_s)


def is_too_late(waited_s: float, allowed_s: float) -> bool:
    """Return whether a command that waited for *waited_s* of *allowed_s* is refused."""
    return waited_s > max(MAX_QUEUED_SHARE * allowed_s, allowed_s - RESERVE_S)

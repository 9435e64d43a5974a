"""Decide which commands a server refuses because it is overloaded, and how long a refused robot pauses.

The rule is random early detection (RED), with the expected wait of a command in the place of RED's mean
length of the queue:

1. The expected wait is the number of commands ahead in the queue, times the mean wait for each position
   (`WaitPerPosition`).
2. A command whose expected wait is below `MIN_WAIT_SHARE` of the time from its arrival to its deadline is
   accepted.
3. Above that, the probability of a refusal grows linearly with the expected wait, and is 1 at the maximum
   wait: `MAX_WAIT_SHARE` of the time to the deadline or, if that is later, `RESERVE_S` before the deadline.
   With a fixed threshold instead, the length of the queue would oscillate.
4. Exception to step 3: a command of a tenant of which fewer commands than of the average tenant were accepted
   lately is never refused, so that a tenant that floods the server cannot displace the others.
5. An accepted command that has waited for too long when it could start (`is_too_late`) is refused after all.

A refused robot has to pause for about `PAUSE_S`, several frames, because a refusal costs half as much CPU
time as a small answer.  A robot that sends more than `MAX_EARLY_COMMANDS` in its pause is read one command at
a time from then on, so that TCP holds its other commands back.

Instead of random numbers, an additive recurrence (Weyl sequence) spreads refusals and pauses evenly.  Times
go in, decisions come out: there is no clock here.

Source:
    Floyd and Jacobson, Random Early Detection Gateways for Congestion Avoidance, 1993.
"""

from __future__ import annotations

import math

__all__ = ["MAX_EARLY_COMMANDS", "PAUSE_S", "OverloadControl", "WaitPerPosition", "is_too_late"]

# Share of the time from arrival to deadline: a command with a shorter expected wait is always accepted.
MIN_WAIT_SHARE = 0.2
# Share of the time from arrival to deadline: a command with a longer expected wait is refused, because
# computation and network need the rest.  Commands of a tenant with fewer than average are still accepted.
MAX_WAIT_SHARE = 0.5
# Share of the time from arrival to deadline: a queued command that has waited for longer is refused, because
# its answer would come too late.
MAX_QUEUED_SHARE = 0.75
# Seconds that computation and network need at most.  A wait until this time before the deadline is allowed,
# even if it is longer than `MAX_WAIT_SHARE` or `MAX_QUEUED_SHARE` of the time from arrival to deadline.
RESERVE_S = 1.5
PAUSE_S = 1.0  # mean pause of a refused robot in seconds: five frames of a camera at 5 Hz
MAX_EARLY_COMMANDS = 8  # commands that a robot may send in one pause: so many may be in flight when it begins
HALVING_S = 1.0  # seconds between halvings of the counts of accepted commands: several frames of each robot
WAIT_SMOOTHING = 0.01  # weight of the newest wait in the moving average: one burst must not cause refusals
GOLDEN_RATIO = 0.6180339887  # step of the additive recurrence: few consecutive numbers are then spread evenly


class OverloadControl:
    """Decides by the rule of this module which commands of one queue are refused."""

    def __init__(self) -> None:
        self._spread = 0.0  # the present number of the additive recurrence, in [0, 1)
        self._accepted: dict[str, int] = {}  # accepted commands by tenant, halved every `HALVING_S`
        self._accepted_of_all = 0
        self._halved_s = -math.inf

    def pause_s(self, tenant: str, expected_wait_s: float, allowed_s: float) -> float:
        """Return 0 to accept a command, or refuse it and return the seconds for which its robot pauses.

        Pauses are spread evenly from 0.5 to 1.5 `PAUSE_S`, so that robots which are refused together do not
        return together.  The state changes with a refusal and with `note_accepted`, but not if 0 is returned,
        so that a command which is accepted before it is decoded is also accepted after that.

        Args:
            tenant: The tenant of the robot.
            expected_wait_s: Seconds for which the command would wait in the queue.
            allowed_s: Seconds from the arrival of the command to its deadline.
        """
        min_wait_s = MIN_WAIT_SHARE * allowed_s
        if expected_wait_s <= min_wait_s or allowed_s <= 0.0 or self._is_below_average(tenant):
            return 0.0  # a command without time left is refused as expired, not for overload
        max_wait_s = max(MAX_WAIT_SHARE * allowed_s, allowed_s - RESERVE_S)
        refused_share = min(1.0, (expected_wait_s - min_wait_s) / (max_wait_s - min_wait_s))
        spread = self._spread / refused_share
        if spread >= 1.0:
            return 0.0
        self._advance()
        return PAUSE_S * (0.5 + spread)

    def note_accepted(self, tenant: str, now: float) -> None:
        """Count a command of *tenant* that was accepted at *now* (monotonic s)."""
        if now - self._halved_s >= HALVING_S:
            self._halved_s = now
            self._accepted = {name: count // 2 for name, count in self._accepted.items() if count > 1}
            self._accepted_of_all = sum(self._accepted.values())
        self._accepted[tenant] = self._accepted.get(tenant, 0) + 1
        self._accepted_of_all += 1
        self._advance()

    def _is_below_average(self, tenant: str) -> bool:
        """Return whether *tenant*, this command included, has fewer accepted commands than the average."""
        own = self._accepted.get(tenant, 0)
        return (own + 1) * len(self._accepted) < self._accepted_of_all

    def _advance(self) -> None:
        """Go to the next number of the additive recurrence."""
        self._spread = (self._spread + GOLDEN_RATIO) % 1.0


class WaitPerPosition:
    """The exponential moving average of a command's wait in seconds, divided by its position in the queue."""

    def __init__(self) -> None:
        self.mean_s = 0.0

    def note(self, waited_s: float, position: int) -> None:
        """Update the average by a command that was started or refused after *waited_s* seconds in the queue.

        *position* is the command's position in the queue when it was queued; 1 is the front.
        """
        self.mean_s += WAIT_SMOOTHING * (waited_s / position - self.mean_s)


def is_too_late(waited_s: float, allowed_s: float) -> bool:
    """Return whether a command is refused because it has waited for *waited_s* seconds.

    *allowed_s* are the seconds from its arrival to its deadline.  The limit is `MAX_QUEUED_SHARE` of them or,
    if that is later, `RESERVE_S` before the deadline.
    """
    return waited_s > max(MAX_QUEUED_SHARE * allowed_s, allowed_s - RESERVE_S)

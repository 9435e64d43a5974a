"""Wait between two attempts to connect, and end the wait early when the cause of the failure may be gone.

`client_sdk.network.backoff` computes the length of the wait.  After an attempt that nobody answered, a new
network ends it early; after a refusal, a change of the robot's wall clock does, because tokens are signed by
it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from client_sdk.concurrency.tasks import wait_for_event
from client_sdk.network.backoff import AttemptResult, Backoff
from client_sdk.network.dial_errors import DialError
from client_sdk.network.network_changes import NetworkChanges

__all__ = ["ReconnectWait"]

CLOCK_POLL_S = 1.0
"""Seconds between two comparisons of the wall clock with the monotonic clock while a refused robot waits."""
CLOCK_STEP_S = 0.5
"""A wall clock that moved by more than this many seconds against the monotonic clock was set by somebody."""
SHORT_REFUSAL_S = 2.0
"""A refusal that ends within this time is not reported: commands and a first connect wait for its end."""


class ReconnectWait:
    """Pause one robot between its attempts to connect."""

    def __init__(self, clock: Callable[[], float], wall_clock: Callable[[], float]) -> None:
        """Keep two clocks: *clock* is monotonic, *wall_clock* (Unix seconds) gives tokens their time."""
        self._clock = clock
        self.wall_clock = wall_clock
        self._network = NetworkChanges(self._note_network_change)
        self._network_changed = asyncio.Event()

    def start_watching_network(self) -> None:
        """Begin to receive the kernel's notifications of network changes."""
        self._network.open()

    def stop_watching_network(self) -> None:
        """Receive no more notifications of network changes."""
        self._network.close()

    def pause_s(
        self, backoff: Backoff, failure: DialError | None, *, spent_s: float = 0.0, is_move: bool = False
    ) -> float:
        """Return how many seconds to wait from now before the next attempt.

        Args:
            backoff: Computes the pause.
            failure: Failure of the last attempt; None if none has failed since the connection was lost.
            spent_s: How long the last attempt took.  It counts towards the pause, so that an attempt that
                timed out is repeated at once; after a refusal it does not.
            is_move: Whether the robot is connected and only changes the server.

        Returns:
            At least the time that the server asked for in its answer.
        """
        retry_after_s = 0.0 if failure is None else failure.retry_after_s
        last = _attempt_result(failure)
        pause_s = backoff.pause_s(
            self._clock(), retry_after_s, last=last, valid_in_s=self._valid_in_s(failure), is_move=is_move
        )
        return pause_s if last is AttemptResult.REFUSED else max(retry_after_s, pause_s - spent_s)

    def is_lasting_refusal(self, failure: DialError | None) -> bool:
        """Return whether a server refused this robot and does not accept it again within two seconds."""
        valid_in_s = self._valid_in_s(failure)
        is_short = valid_in_s is not None and valid_in_s <= SHORT_REFUSAL_S
        return failure is not None and failure.is_refusal and not is_short

    def clock_offset_s(self) -> float:
        """Return wall clock minus monotonic clock in seconds; it changes only if the wall clock is set."""
        return self.wall_clock() - asyncio.get_running_loop().time()

    async def wait(self, pause_s: float, failure: DialError | None, clock_offset_s: float) -> None:
        """Wait for *pause_s* seconds, or until a change of network or wall clock makes an attempt worthwhile.

        Args:
            pause_s: Longest wait from now.
            failure: Failure of the last attempt; None if there was none.  A new network ends the wait after
                an unanswered attempt, and a clock that was set ends it after a refusal.
            clock_offset_s: `clock_offset_s` at the start of the last attempt: the wall clock may have been
                set since then.
        """
        last, monotonic_s = _attempt_result(failure), asyncio.get_running_loop().time
        until_s = monotonic_s() + pause_s
        while (left_s := until_s - monotonic_s()) > 0:
            if last is AttemptResult.UNANSWERED:
                network_changed = self._network_changed
                await wait_for_event(network_changed, left_s)
                if network_changed.is_set():
                    return
            elif last is AttemptResult.REFUSED:
                if abs(self.clock_offset_s() - clock_offset_s) > CLOCK_STEP_S:
                    return
                await asyncio.sleep(min(left_s, CLOCK_POLL_S))
            else:
                await asyncio.sleep(left_s)

    def _valid_in_s(self, failure: DialError | None) -> float | None:
        if failure is None or failure.valid_from_s is None:
            return None
        return failure.valid_from_s - self.wall_clock()

    def _note_network_change(self) -> None:
        self._network_changed.set()
        self._network_changed = asyncio.Event()


def _attempt_result(failure: DialError | None) -> AttemptResult:
    if failure is None:
        return AttemptResult.NONE
    if failure.is_refusal:
        return AttemptResult.REFUSED
    return AttemptResult.UNANSWERED if failure.is_unanswered else AttemptResult.ANSWERED

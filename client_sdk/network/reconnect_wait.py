"""How long a robot waits between two attempts to connect, and what ends a pause early.

A pause after an attempt that nobody answered ends when the kernel has another network, and one after a
refusal when somebody sets the clock of the robot.  Nothing here dials.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from client_sdk.network.backoff import Backoff, Last
from client_sdk.network.dial_errors import DialError
from client_sdk.network.network_changes import NetworkChanges
from client_sdk.network.region_sockets import either

__all__ = ["Pauses", "last_of"]

# How often the clock is looked at, and by how much it must have been set.
_LOOK_S, _CLOCK_SET_S = 1.0, 0.5
# Calls wait for the end of a cut-off that is so near, instead of failing; so does a first connect.
_SOON_S = 2.0


class Pauses:
    """The pauses of one robot, between `open` and `close`; *wall_clock* is the one that signs its tokens."""

    def __init__(self, clock: Callable[[], float], wall_clock: Callable[[], float]) -> None:
        self._clock = clock
        self.wall_clock = wall_clock
        self._network = NetworkChanges(self._network_changed)
        self._has_changed = asyncio.Event()

    def open(self) -> None:
        """Listen to the kernel."""
        self._network.open()

    def close(self) -> None:
        """Listen no longer."""
        self._network.close()

    def pause_s(
        self, backoff: Backoff, failed: DialError | None, *, spent_s: float = 0.0, is_move: bool = False
    ) -> float:
        """Return how long to wait after an attempt that *failed*; None means that there was none.

        A pause counts from the start of the attempt, which took *spent_s*, so that none is added after one
        that timed out; but what a server asked for or refused counts from its answer.
        """
        asked_s = 0.0 if failed is None else failed.after_s
        last = last_of(failed)
        pause_s = backoff.pause_s(
            self._clock(), asked_s, last=last, valid_in_s=self._valid_in_s(failed), is_move=is_move
        )
        return pause_s if last is Last.REFUSED else max(asked_s, pause_s - spent_s)

    def is_lasting(self, failed: DialError | None) -> bool:
        """Return whether *failed* is a refusal, and not one that is known to be over soon."""
        valid_in_s = self._valid_in_s(failed)
        is_soon = valid_in_s is not None and valid_in_s <= _SOON_S
        return failed is not None and failed.is_refusal and not is_soon

    def offset_s(self) -> float:
        """Return the time of the wall clock over that of the event loop; it changes if the clock is set."""
        return self.wall_clock() - asyncio.get_running_loop().time()

    async def wait(self, pause_s: float, failed: DialError | None, offset_s: float) -> None:
        """Wait for *pause_s*, or until something else than time makes another attempt worthwhile.

        Args:
            pause_s: From now.
            failed: Of the last attempt.
            offset_s: `offset_s` when the last attempt began: the clock may have been set since then.
        """
        last, loop_time = last_of(failed), asyncio.get_running_loop().time
        until = loop_time() + pause_s
        while (left_s := until - loop_time()) > 0:
            if last is Last.UNANSWERED:
                changed = self._has_changed
                await either(changed, left_s)
                if changed.is_set():
                    return
            elif last is Last.REFUSED:
                if abs(self.offset_s() - offset_s) > _CLOCK_SET_S:
                    return
                await asyncio.sleep(min(left_s, _LOOK_S))
            else:
                await asyncio.sleep(left_s)

    def _valid_in_s(self, failed: DialError | None) -> float | None:
        if failed is None or failed.valid_from_s is None:
            return None
        return failed.valid_from_s - self.wall_clock()

    def _network_changed(self) -> None:
        self._has_changed.set()
        self._has_changed = asyncio.Event()


def last_of(failed: DialError | None) -> Last:
    """Return how the last attempt ended, if it was the one that *failed*."""
    if failed is None:
        return Last.NONE
    if failed.is_refusal:
        return Last.REFUSED
    return Last.UNANSWERED if failed.is_unanswered else Last.ANSWERED

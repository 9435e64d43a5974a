"""What a worker's core needs of the world: a socket, an event loop, clocks; tests bring their own.

Promises to hold no code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

__all__ = ["Clocks", "Handle", "Loop", "Wire"]


class Wire(Protocol):
    """The socket of one robot, as the core sees it."""

    def send(self, data: bytes, is_text: bool) -> None:
        """Write one message; does nothing on a socket that ended."""

    def send_pong(self, data: bytes) -> None:
        """Write one pong frame."""

    def pause(self, seconds: float) -> None:
        """Read nothing more for so long."""

    def hold(self) -> None:
        """Read nothing more until as many `read_on` have come."""

    def read_on(self) -> None:
        """Take one `hold` back."""

    def close(self, code: int, reason: str) -> None:
        """Write a close frame and end the connection."""


class Handle(Protocol):
    """A timer that can be taken back."""

    def cancel(self) -> None:
        """Do not call."""


class Loop(Protocol):
    """What the core needs of an event loop."""

    def call_later(self, delay: float, callback: Callable[[], object]) -> Handle:
        """Call *callback* in *delay* seconds."""

    def call_soon_threadsafe(self, callback: Callable[..., object], *args: Any) -> object:
        """Call *callback* in the loop's thread."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clocks:
    """The readings of time a worker takes: monotonic s, Unix s, CPU s of the process."""

    monotonic: Callable[[], float]
    wall: Callable[[], float]
    cpu: Callable[[], float]

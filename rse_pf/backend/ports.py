"""What the parts of a worker need of the outside: a socket, an event loop, a log, clocks and settings."""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from rse_pf.backend.log import JsonLog
from rse_pf.backend.metrics import Metrics
from rse_pf.config import PlatformSettings
from rse_pf.recording.tap import RecordingTap

__all__ = ["Clocks", "Log", "SlowReader", "Wire", "WorkerContext"]


class Wire(Protocol):
    """The socket of one robot."""

    def send(self, data: bytes, is_text: bool) -> None:
        """Write one message; does nothing on a socket that ended."""

    def unsent_bytes(self) -> int:
        """Return how many bytes wait in this process, because the kernel does not take more."""

    def bound_unsent(self, max_bytes: int) -> None:
        """Let the kernel take no more than *max_bytes* that the network has not taken."""

    def send_pong(self, data: bytes) -> None:
        """Write one pong frame."""

    def send_ping(self) -> None:
        """Write one ping frame; does nothing on a socket that ended."""

    def pause(self, seconds: float) -> None:
        """Read nothing more for *seconds*."""

    def hold(self) -> None:
        """Read nothing more until `read_on` was called as often as this."""

    def read_on(self) -> None:
        """End one `hold`."""

    def close(self, code: int, reason: str) -> None:
        """Write a close frame and end the connection."""


class SlowReader(Protocol):
    """A connection to which messages are written only as fast as its other end reads them."""

    is_connected: bool

    @property
    def unsent_bytes(self) -> int:
        """How much was written that the kernel has not taken."""

    def bound_unsent(self, max_bytes: int) -> None:
        """Let the kernel take no more than *max_bytes* that the network has not taken."""

    def write(self, data: bytes) -> None:
        """Write one message."""


class Log(Protocol):
    """Where events go; `rse_pf.backend.log.JsonLog` is one."""

    def info(self, event: str, **fields: Any) -> None:
        """Write what happened."""

    def warning(self, event: str, **fields: Any) -> None:
        """Write what an operator should look at."""

    def error(self, event: str, **fields: Any) -> None:
        """Write a defect."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clocks:
    """The clocks of a worker: monotonic s, Unix s, and CPU s of the process."""

    monotonic: Callable[[], float]
    wall: Callable[[], float]
    cpu: Callable[[], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerContext:
    """What all parts of one worker share; ``server_id`` goes into welcomes and answers.

    ``tap`` takes the messages of all connections for a recording; None where nothing is recorded.
    """

    settings: PlatformSettings
    server_id: str
    clocks: Clocks
    loop: AbstractEventLoop
    log: JsonLog
    metrics: Metrics = field(default_factory=Metrics)
    tap: RecordingTap | None = None

"""The interface by which a local platform passes its events and samples to a recorder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

__all__ = ["NullPlatformRecorder", "PlatformRecorder"]


class PlatformRecorder(Protocol):
    """Record the events of a platform and the samples of its monitor; no method raises."""

    def begin(self) -> None:
        """Begin to record; called before the first server starts, with the platform's lock held."""

    def record_event(self, event: Mapping[str, Any]) -> None:
        """Record one event of the platform."""

    def record_sample(self, sample: Mapping[str, Any]) -> None:
        """Record one sample of the monitor."""

    def close(self) -> None:
        """Finish the recording; called after all servers have exited."""


class NullPlatformRecorder:
    """A recorder that records nothing, for a platform without recordings."""

    def begin(self) -> None:
        """Do nothing."""

    def record_event(self, event: Mapping[str, Any]) -> None:
        """Ignore an event."""

    def record_sample(self, sample: Mapping[str, Any]) -> None:
        """Ignore a sample."""

    def close(self) -> None:
        """Do nothing."""

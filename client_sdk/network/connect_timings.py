"""Settings of a robot's attempts to connect; they are the robot's own, and no server knows them."""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.errors import UsageError

__all__ = ["ConnectTimings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectTimings:
    """Hold the timeouts and longest pauses of attempts to connect, in seconds.

    Attributes:
        connect_timeout_s: Time limit of each step of an attempt: proxy, WebSocket handshake, Welcome.
        reconnect_max_s: Longest pause between attempts that have failed for less than three times as long.
        reconnect_long_max_s: Longest pause between attempts that have failed for longer; after a refusal the
            pause is between half of this number and all of it.
        region_hold_s: How long another region must be clearly nearer before a robot with several addresses
            changes to it: its round trip is at most 75 % of the present one, and 20 ms shorter.

    Raises:
        UsageError: A number is not positive, or *reconnect_long_max_s* is less than *reconnect_max_s*.
    """

    connect_timeout_s: float = 2.0
    reconnect_max_s: float = 1.0
    reconnect_long_max_s: float = 40.0
    region_hold_s: float = 60.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise UsageError(
                    f"{name} = {getattr(self, name)} is not positive", hint="set a positive number of seconds"
                )
        if self.reconnect_long_max_s < self.reconnect_max_s:
            raise UsageError(
                f"reconnect_long_max_s = {self.reconnect_long_max_s:g} is less than reconnect_max_s = "
                f"{self.reconnect_max_s:g}",
                hint="raise reconnect_long_max_s",
            )

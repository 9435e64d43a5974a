"""How patient a robot is with its network: numbers of the robot's own, which no server knows."""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.errors import UsageError

__all__ = ["ConnectTimings"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectTimings:
    """Limits of attempts to connect.

    Attributes:
        connect_timeout_s: Time limit of one attempt.
        reconnect_max_s: Longest pause between attempts in the first seconds without a connection.
        reconnect_long_max_s: Longest pause after minutes without a connection; after a refusal at least half
            of it.
        region_hold_s: A robot with several addresses changes to another region that has been clearly nearer
            for this long.

    Raises:
        UsageError: A number is not positive, or the longer pause is the shorter one.
    """

    connect_timeout_s: float = 2.0
    reconnect_max_s: float = 1.0
    reconnect_long_max_s: float = 40.0
    region_hold_s: float = 60.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise UsageError(
                    f"{name} = {getattr(self, name)} is not positive", hint="set a number of seconds"
                )
        if self.reconnect_long_max_s < self.reconnect_max_s:
            raise UsageError(
                f"reconnect_long_max_s = {self.reconnect_long_max_s:g} is less than reconnect_max_s = "
                f"{self.reconnect_max_s:g}",
                hint="raise reconnect_long_max_s",
            )

"""A fake instance: its server, its lifecycle, and its time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from botocore.exceptions import ClientError

from rse_pf.aws.fleet.task import AgentConfig, AgentContext
from rse_pf.config import PlatformSettings
from rse_pf.errors import Disconnected
from rse_pf.storage.object_store import MemoryStore

WALL_S = float(int(time.time()) // 60 * 60)
"""The wall clock of every machine at 120 s: the begin of this minute."""


class FakeMachine:
    """A machine whose server ends ``ends_after_s`` after its drain, when it runs at all."""

    def __init__(self, *, runs: bool = True, ends_after_s: float = 20.0) -> None:
        self.now_s = 100.0
        self.runs = runs
        self.leaving = False
        self.ready = True
        self.reaches = True
        self.target = "InService"
        self.text = ""
        self.waits: list[float] = []
        self.moves: list[tuple[int, float]] = []
        self.notice = ""
        self.reloads = 0
        self.cpu = (0.0, 0.0)
        self._ends_after_s = ends_after_s
        self._ended_at_s = float("inf")

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def instance_id(self) -> str:
        return "i-0123456789abcdef0"

    def target_state(self) -> str:
        return "Terminated" if self.leaving else self.target

    def is_ready(self) -> bool:
        return self.ready

    def wall_clock(self) -> float:
        """Return Unix seconds; a period of a minute ends at 120."""
        return WALL_S + self.now_s - 120.0

    def cpu_times(self) -> tuple[float, float]:
        return self.cpu

    def spot_notice(self) -> str:
        return self.notice

    def move(self, robots: int, spread_s: float) -> int:
        self.page()
        self.moves.append((robots, spread_s))
        return robots

    def reload_services(self) -> None:
        self.page()
        self.reloads += 1

    def reaches_store(self) -> bool:
        return self.reaches

    def page(self) -> str:
        if not self.runs or self.now_s >= self._ended_at_s:
            raise Disconnected("no server")
        return self.text

    def drain(self, wait_s: float) -> None:
        self.page()
        self.waits.append(wait_s)
        self._ended_at_s = self.now_s + self._ends_after_s


class FakeScaling:
    """The Auto Scaling service as far as a hook needs it: the emulator has no such call.

    A hook that does not wait is refused, as AWS does; `waits` says which one waits at which time.
    """

    def __init__(self, machine: FakeMachine) -> None:
        self._machine = machine
        self.waits: Callable[[str], bool] = lambda hook: True
        self.completed: list[tuple[float, dict[str, Any]]] = []

    def complete_lifecycle_action(self, **arguments: Any) -> dict[str, Any]:
        if not self.waits(arguments["LifecycleHookName"]):
            refusal = {"Error": {"Code": "ValidationError", "Message": "No active Lifecycle Action found"}}
            raise ClientError(refusal, "CompleteLifecycleAction")
        self.completed.append((self._machine.now_s, arguments))
        return {}


def agent_context(machine: Any, folder: Path, *, group: str = "rse-pf", **changed: Any) -> AgentContext:
    """Return the context of an agent on *machine* with its keys in *folder*; *changed* replaces its parts."""
    config = AgentConfig(
        group=group, hook="drain", launch_hook="launch", keys_name="keys.json",
        keys_file=folder / "keys.json", state_folder=folder,
    )  # fmt: skip
    parts: dict[str, Any] = {
        "machine": machine, "clients": {}, "artifacts": MemoryStore(), "settings": PlatformSettings(),
        "config": config, "log": lambda event, **fields: None, "clock": machine.clock,
        "sleep": machine.sleep, "wall_clock": machine.wall_clock,
    }  # fmt: skip
    return AgentContext(**{**parts, **changed})

"""A fake instance: its server, its lifecycle, and its time."""

from __future__ import annotations

from typing import Any

from rse_pf.errors import Disconnected


class FakeMachine:
    """A machine whose server ends ``ends_after_s`` after its drain, when it runs at all."""

    def __init__(self, *, runs: bool = True, ends_after_s: float = 20.0) -> None:
        self.now_s = 100.0
        self.runs = runs
        self.leaving = False
        self.text = ""
        self.waits: list[float] = []
        self._ends_after_s = ends_after_s
        self._ended_at_s = float("inf")

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def instance_id(self) -> str:
        return "i-0123456789abcdef0"

    def is_leaving(self) -> bool:
        return self.leaving

    def page(self) -> str:
        if not self.runs or self.now_s >= self._ended_at_s:
            raise Disconnected("no server")
        return self.text

    def drain(self, wait_s: float) -> None:
        self.page()
        self.waits.append(wait_s)
        self._ended_at_s = self.now_s + self._ends_after_s


class FakeScaling:
    """The Auto Scaling service as far as a hook needs it: the emulator has no such call."""

    def __init__(self, machine: FakeMachine) -> None:
        self._machine = machine
        self.completed: list[tuple[float, dict[str, Any]]] = []

    def complete_lifecycle_action(self, **arguments: Any) -> dict[str, Any]:
        self.completed.append((self._machine.now_s, arguments))
        return {}

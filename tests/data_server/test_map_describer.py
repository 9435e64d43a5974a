"""Maps are read in a process that may be killed: hostile ones cost that process, and then their robot."""

from __future__ import annotations

from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.data_server.map_describer import TARGET, MapDescriber
from rse_pf.data_server.robot_processes import RobotProcesses
from rse_pf.errors import Busy, Crashed
from rse_pf.identity import RobotId
from rse_pf.limits.crash_record import BLOCK_S
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import MemoryStore

ROBOT, OTHER = RobotId("acme", "robot-1"), RobotId("rival", "robot-1")
MAP = encode_map(MapVersion(keyframes=()))


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


class Killed:
    """Processes that every map kills."""

    def __init__(self) -> None:
        self.calls = 0

    def call(self, data: bytes, timeout_s: float, **_: Any) -> bytes:
        self.calls += 1
        raise Crashed("the process ended: signal SIGKILL")

    def close(self) -> None:
        """End nothing."""


def test_a_robot_whose_maps_ended_two_processes_is_refused_for_a_while(clock: Clock) -> None:
    store, processes = MemoryStore(), Killed()
    store.put("map", MAP)
    asked: Any = processes
    made = MapDescriber(RobotProcesses(TARGET, PlatformSettings(), store, clock, processes=asked))

    for _ in range(2):
        with pytest.raises(Crashed):
            made.describe(ROBOT, "map")
    with pytest.raises(Busy) as refused:
        made.describe(ROBOT, "map")

    assert processes.calls == 2
    assert refused.value.retry_after_ms == 1000 * BLOCK_S
    with pytest.raises(Crashed):
        made.describe(OTHER, "map")
    clock.now += BLOCK_S
    with pytest.raises(Crashed):
        made.describe(ROBOT, "map")

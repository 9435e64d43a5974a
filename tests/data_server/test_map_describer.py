"""Maps are read in a process that may be killed: hostile ones cost that process, and then their robot."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.data_server.map_describer import TARGET, MapDescriber
from rse_pf.data_server.robot_processes import RobotProcesses
from rse_pf.errors import Busy, Crashed, RsePfError
from rse_pf.identity import RobotId
from rse_pf.limits.crash_record import BLOCK_S
from rse_pf.maps.describe import MapSummary
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.storage.object_store import DirectoryStore, MemoryStore
from tests.kit.fake_data_service import small_settings

ROBOT, OTHER = RobotId("acme", "robot-1"), RobotId("rival", "robot-1")
EMPTY = MapSummary(keyframes=0, edges=0, points=0, robots=())
MAP = encode_map(MapVersion(keyframes=()))


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def describer(tmp_path: Path, clock: Clock) -> Iterator[MapDescriber]:
    """One for a store in a folder, which the process reads itself."""
    settings = small_settings(store=f"dir:{tmp_path}", max_object_bytes=1 << 20)
    made = MapDescriber(RobotProcesses(TARGET, settings, MemoryStore(), clock))
    yield made
    made.close()


def test_the_process_reads_the_store_itself_and_counts(describer: MapDescriber, tmp_path: Path) -> None:
    DirectoryStore(tmp_path).put("objects/acme/robot-1/a", MAP)

    assert describer.describe(ROBOT, "objects/acme/robot-1/a") == EMPTY
    with pytest.raises(RsePfError, match="no object"):
        describer.describe(ROBOT, "objects/acme/robot-1/b")


def test_a_store_in_memory_is_read_by_the_data_server(clock: Clock) -> None:
    store = MemoryStore()
    store.put("map", MAP)
    store.put("none", b"x")
    made = MapDescriber(RobotProcesses(TARGET, small_settings(), store, clock))
    try:
        assert made.describe(ROBOT, "map") == EMPTY
        with pytest.raises(RsePfError):
            made.describe(ROBOT, "none")
    finally:
        made.close()


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

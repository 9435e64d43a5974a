"""How a map server measures keyframes: with fewer candidates while many wait; and optimises the graph."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import TypeVar

import numpy as np
import pytest

from rse_pf.geometry import Array, exp_se3, inverse
from rse_pf.live_map.events import Event, LoopClosuresMeasured
from rse_pf.server.live_map.map_server.environment import Urgency
from rse_pf.server.live_map.map_server.measurement import (
    KeyframeMeasurer,
    optimise_in_child,
    optimise_in_process,
)
from rse_pf.server.live_map.map_server.state import MapState
from rse_pf.slam.optimise import OptimiseOptions
from rse_pf.slam.pose_graph import PoseGraph
from tests.kit.fake_map import FakeMap
from tests.kit.fakes import FakeLog
from tests.kit.map_server_setup import settle

_T = TypeVar("_T")


class HeldThreads:
    """Threads that compute at once, and match when the test allows it."""

    def __init__(self) -> None:
        self.looking: list[asyncio.Event] = []

    async def compute(self, urgency: Urgency, act: Callable[[], _T]) -> _T:
        return act()

    def match(self, act: Callable[[], _T]) -> asyncio.Future[_T]:
        held = asyncio.Event()
        self.looking.append(held)
        return asyncio.ensure_future(self._look(held, act))

    async def _look(self, held: asyncio.Event, act: Callable[[], _T]) -> _T:
        await held.wait()
        return act()

    store = lease = background = match


class NotingMap(FakeMap):
    """Records with which arguments each keyframe is measured."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[tuple[int, int, int | None]] = []

    def prepare_measurement(
        self, keyframe: int, pieces: int = 1, candidates: int | None = None
    ) -> list[Callable[[], LoopClosuresMeasured]]:
        self.asked.append((keyframe, pieces, candidates))
        return [lambda: LoopClosuresMeasured(keyframe=keyframe)] * pieces


async def test_waiting_keyframes_are_measured_two_at_a_time_and_one_alone_by_both_threads() -> None:
    live_map, threads, submitted = NotingMap(), HeldThreads(), list[Event]()
    environment = SimpleNamespace(
        threads=threads, optimise=optimise_in_process, map_name="warehouse", log=FakeLog()
    )
    measurer = KeyframeMeasurer(MapState(live_map, 0), environment, submitted.append)
    working = asyncio.ensure_future(measurer.run())
    measurer.add_keyframes(range(20))
    await settle()
    assert [arguments[:2] for arguments in live_map.asked] == [(0, 1), (1, 1)]
    assert all(candidates is not None for _, _, candidates in live_map.asked)
    while len(submitted) < 20:
        for held in threads.looking:
            held.set()
        await settle()
    assert sorted(event.keyframe for event in submitted) == list(range(20))  # type: ignore[union-attr]
    live_map.asked.clear()
    measurer.add_keyframes([20])
    await settle()
    assert live_map.asked == [(20, 2, None)]
    working.cancel()
    await asyncio.wait({working})


@pytest.mark.slow  # starts a process
def test_a_graph_that_is_fitted_apart_has_the_same_poses() -> None:
    graph = _loop()
    apart = optimise_in_child(graph, OptimiseOptions())
    assert apart.tobytes() == optimise_in_process(graph, OptimiseOptions()).tobytes()
    assert not np.array_equal(apart, graph.T_world_pose)


def _loop() -> PoseGraph:
    """Return the pose graph of a loop with exact edges and drifted poses."""
    n = 12
    rng = np.random.default_rng(0)
    true: Array = np.array([exp_se3(np.array([0.3 * i, 0.0, 0.0, 0.0, 0.0, 0.5 * i])) for i in range(n)])
    a, b = np.arange(n), (np.arange(n) + 1) % n
    drifted = np.array([pose @ exp_se3(0.02 * i * rng.standard_normal(6)) for i, pose in enumerate(true)])
    return PoseGraph(
        T_world_pose=drifted,
        a=a,
        b=b,
        robust=a == n - 1,
        ids=a,
        T_a_b=np.array([inverse(true[i]) @ true[j] for i, j in zip(a, b, strict=True)]),
        information=np.tile(1e4 * np.eye(6), (n, 1, 1)),
    )

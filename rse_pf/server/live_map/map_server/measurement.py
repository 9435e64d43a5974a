"""Measure loop closures of new keyframes and optimise the whole pose graph, while the map is served.

A keyframe is acknowledged before its loop closures are measured.  The results enter the log of the map as
events of their own, so that a replay of the log measures nothing.
"""

from __future__ import annotations

import asyncio
import functools
import io
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from rse_pf.errors import Crashed
from rse_pf.geometry import Array
from rse_pf.live_map.events import Event
from rse_pf.live_map.measure import merge_measurements
from rse_pf.processes.ipc import encode_message, receive
from rse_pf.processes.start import ChildPlan, how_ended, start_child
from rse_pf.server.live_map.map_server.environment import MapServerEnvironment, Urgency
from rse_pf.server.live_map.map_server.state import MapState
from rse_pf.slam.optimise import OptimiseOptions, optimise_graph
from rse_pf.slam.pose_graph import PoseGraph

__all__ = [
    "KeyframeMeasurer",
    "choose_candidate_count",
    "optimise_in_child",
    "optimise_in_process",
    "run_optimisation",
]

_CONCURRENT_MEASUREMENTS = 2
"""Number of parallel measurements: of that many keyframes, or, if no further keyframe waits, of that many
parts of the candidates of one keyframe."""
_SHORT_QUEUE = 4
"""With at most this number of waiting keyframes, each keyframe is compared with all candidates that the map
chooses."""
_CANDIDATES_WITH_LONG_QUEUE = 6
"""Most candidates with which a keyframe is compared while 5 to 8 keyframes wait for measurement."""
_CANDIDATES_WITH_VERY_LONG_QUEUE = 4
"""Most candidates with which a keyframe is compared while more than 8 keyframes wait for measurement."""
_OPTIMISATION_NICE = 10
"""Niceness of the child process that optimises a whole graph: keyframes and poses have priority."""
_MAX_OPTIMISATION_S = 120.0
"""Seconds after which the child process that optimises a whole graph is killed; the failure is logged, and
the poses of the map stay as they are."""
_GRAPH_FIELDS = ("T_world_pose", "a", "b", "T_a_b", "information", "robust", "ids")
"""The fields of `PoseGraph`, all of them arrays, that are sent to the child process."""


def choose_candidate_count(waiting: int) -> int | None:
    """Return with how many candidates at most a keyframe is compared while *waiting* other keyframes wait.

    None stands for the map's own limit.  Fewer candidates let a map server that is behind catch up.  A replay
    does not depend on this number, because the measured loop closures are in the log.
    """
    if waiting <= _SHORT_QUEUE:
        return None
    return _CANDIDATES_WITH_LONG_QUEUE if waiting <= 2 * _SHORT_QUEUE else _CANDIDATES_WITH_VERY_LONG_QUEUE


class KeyframeMeasurer:
    """Measures the loop closures of keyframes, and optimises the graph on request while no keyframe waits.

    Measurements begin in the order of the keyframes; the results are submitted to the log as events.

    All methods are called in the event loop.
    """

    def __init__(
        self,
        state: MapState,
        environment: MapServerEnvironment,
        submit: Callable[[Event], Any],
    ) -> None:
        """Queue the keyframes that the previous map server has not measured; `run` begins with them.

        Args:
            state: The map.
            environment: Environment of the map server.
            submit: Queues an event for the log; its result is not used.
        """
        self._state = state
        self._environment = environment
        self._threads = environment.threads
        self._submit = submit
        self._waiting = deque(state.unmeasured)
        self._has_work = asyncio.Event()
        self._has_work.set()
        self._needs_optimisation = False
        self._has_measured = False

    @property
    def is_proven(self) -> bool:
        """Whether this process has measured a keyframe, and all keyframes of the map are measured.

        No keyframe that the previous map server left unmeasured then crashes this process.
        """
        return self._has_measured and not self._state.unmeasured

    def add_keyframes(self, keyframes: Iterable[int]) -> None:
        """Queue the keyframes with these ids for the measurement of their loop closures."""
        self._waiting.extend(keyframes)
        self._has_work.set()

    def request_optimisation(self) -> None:
        """Request one optimisation of the whole pose graph, which begins when no keyframe waits.

        Further calls before it begins have no effect.
        """
        self._needs_optimisation = True
        self._has_work.set()

    async def run(self) -> None:
        """Measure queued keyframes and do requested optimisations until this task is cancelled."""
        await asyncio.gather(*(self._work() for _ in range(_CONCURRENT_MEASUREMENTS)))

    async def _work(self) -> None:
        while True:
            await self._has_work.wait()
            if self._waiting:
                await self._measure_keyframe(self._waiting.popleft())
            elif self._needs_optimisation:
                self._needs_optimisation = False
                await self._optimise_graph()
            else:
                self._has_work.clear()

    async def _measure_keyframe(self, keyframe: int) -> None:
        waiting = len(self._waiting)
        parts = 1 if waiting else _CONCURRENT_MEASUREMENTS
        # 1. Choose the candidates, and copy what is compared, in the thread of the map.
        prepare = functools.partial(
            self._state.prepare_measurement, keyframe, parts, choose_candidate_count(waiting)
        )
        measurements = await self._threads.compute(Urgency.MEASURE, prepare)
        # 2. Estimate the relative poses in threads for matching.
        begun = [self._threads.match(measure) for measure in measurements]
        # 3. Queue the measured loop closures for the log.
        self._submit(merge_measurements(keyframe, [await measured for measured in begun]))
        self._has_measured = True

    async def _optimise_graph(self) -> None:
        prepare = functools.partial(self._state.prepare_optimisation, self._environment.optimise)
        optimise = await self._threads.compute(Urgency.BACKGROUND, prepare)
        optimised = await self._threads.match(optimise)
        if optimised is None:
            self._environment.log.warning("live-optimisation-failed", map=self._environment.map_name)
        else:
            self._submit(optimised)


def optimise_in_process(graph: PoseGraph, options: OptimiseOptions) -> Array:
    """Optimise a pose graph in the calling process and return its ``(n, 4, 4)`` poses, a new array.

    Raises:
        MissingExtra: gtsam is not installed.
    """
    return optimise_graph(graph, options).T_world_pose


def optimise_in_child(graph: PoseGraph, options: OptimiseOptions) -> Array:
    """Optimise a pose graph in a child process of low priority; return its ``(n, 4, 4)`` poses, read-only.

    gtsam holds Python's interpreter lock (GIL) while it optimises, so in the map server's own process no
    keyframe could be applied meanwhile.  The poses are equal to the bit to those of `optimise_in_process`.

    Raises:
        Crashed: The child process failed, also if gtsam is not installed; its error output is in the log of
            the server.
        TimeoutError: The optimisation took longer than 120 s.
    """
    buffer = io.BytesIO()
    np.savez(buffer, cauchy=options.cauchy, **{name: getattr(graph, name) for name in _GRAPH_FIELDS})
    plan = ChildPlan(target=f"{__name__}:run_optimisation", name="rse-pf fit", nice=_OPTIMISATION_NICE)
    child = start_child(plan)
    try:
        child.say(buffer.getvalue())
        reply = receive(child.connection, time.monotonic() + _MAX_OPTIMISATION_S)
    finally:
        exit_code = child.kill()
    if reply is None:
        raise Crashed(
            f"the optimisation of a whole live map ended with {how_ended(exit_code)}",
            hint="read the error output of the process in the log of the server",
        )
    poses: Array = np.frombuffer(reply, dtype="<f8").reshape(graph.T_world_pose.shape)
    return poses


def run_optimisation(parent: socket.socket) -> None:
    """Read one pose graph from the *parent* process, optimise it and send its poses back as float64 bytes.

    The entry point of the child process of `optimise_in_child`.
    """
    with np.load(io.BytesIO(receive(parent)), allow_pickle=False) as fields:
        graph = PoseGraph(**{name: fields[name] for name in _GRAPH_FIELDS})
        poses = optimise_in_process(graph, OptimiseOptions(cauchy=float(fields["cauchy"])))
    parent.sendall(encode_message(np.ascontiguousarray(poses, dtype="<f8").tobytes()))
